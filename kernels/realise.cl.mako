## Raw counts and S/N of each pixel and resolution element, one work-item to WIDTH realisations.
__kernel ${attributes}
void realise(const uint seed_low, const uint seed_high, const uint first_low, const uint first_high,
             const uint pixel_count, const uint frame_count,
             __global const Pixel *restrict pixels, __global const Level *restrict levels,
             __global const uint *restrict tables, const uint stride, __global float *restrict values)
{
    /* values[pixel][realisation]: DN above the base, summed over the frames. */
    const uint item = get_global_id(0);
    const uintv realisation = (uintv)(first_low + item * ${width}u) + LANE_INDEX;
% if not frames:
    const Address at = address(realisation, first_high, 0u, seed_low, seed_high);
% endif
    for (uint start = 0; start < pixel_count; start += 4u) {
        floatv z[4], d[4];
% if frames:
        floatv sum[4] = {0.0f, 0.0f, 0.0f, 0.0f};
        for (uint frame = 0; frame < frame_count; frame++) {
            const Address at = address(realisation, first_high, frame, seed_low, seed_high);
            draw_noise(&at, ${streams["noise"]}u, start, 4u, z);
            draw_dark(&at, ${streams["dark"]}u, start, 4u, pixels, tables, d);
            for (uint i = 0; i < 4u; i++)
                sum[i] += digitise(z[i], d[i], pixels[start + i].dark_gain, levels + start + i);
        }
        for (uint i = 0; i < 4u; i++)
            STORE(sum[i], values + (size_t)(start + i) * stride + item * ${width}u);
% else:
        draw_noise(&at, ${streams["noise"]}u, start, 4u, z);
        draw_dark(&at, ${streams["dark"]}u, start, 4u, pixels, tables, d);
        for (uint i = 0; i < 4u; i++)
            STORE(digitise(z[i], d[i], pixels[start + i].dark_gain, levels + start + i),
                  values + (size_t)(start + i) * stride + item * ${width}u);
% endif
    }
}

/* An observer's S/N from each realisation's own net signal, clipped at zero under the root (METHODS
   section 5), in place for the pixels and summed for the resolution elements. */
__kernel ${attributes}
void signal_to_noise(const uint pixel_count, __global const Pixel *restrict pixels,
                     __global const Observer *restrict observers, const uint stride, __global float *restrict values)
{
    const uint item = get_global_id(0);
    floatv signal = 0.0f, variance = 0.0f;
    uint element = pixel_count;
    for (uint p = 0; p < pixel_count; p++) {
        __global float *here = values + (size_t)p * stride + item * ${width}u;
        floatv net = LOAD(here) + observers[p].net_offset;
        floatv noise2 = FMA(most(net, (floatv)0.0f), (floatv)observers[p].gain, (floatv)observers[p].variance);
        signal += net * observers[p].used;
        variance = FMA(noise2, (floatv)observers[p].used, variance);
        STORE(net / root(noise2), here);
        if (pixels[p].element_end) {
            STORE(signal / root(variance), values + (size_t)element * stride + item * ${width}u);
            element++;
            signal = 0.0f;
            variance = 0.0f;
        }
    }
}
