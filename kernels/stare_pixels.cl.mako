## Stares by pixel: every frame is drawn with all its noise, rounded, and reduced to a few weighted sums.
<% parts = 4 %>\
__kernel ${attributes}
void stare_pixels(SCENE, STARE, const uint first_low, const uint first_high, const uint start_row, const uint stop_row,
                  const uint first_frame, __global const Mixture *restrict mixtures, __global const float *restrict spectra,
                  __global const float *restrict weights, __global const float *restrict constants,
                  const uint first_pixel, const uint stop_pixel, const uint stride, __global float *restrict values)
{
    /* values[frame][scenario][statistic][stare] */
    const uint item = get_global_id(0), frame = first_frame + get_global_id(1), padded = job->padded_count;
    const uint scenario_count = stare_job->scenario_count;
    const uintv realisation = (uintv)(first_low + item * ${width}u) + LANE_INDEX;
    floatv unknown[${4 * unknown_groups + 1}];
% if unknown_groups:
    unknowns_of(*stare_job, realisation, first_high, job->seed_low, job->seed_high, unknown);
% endif
    const Address at = address(realisation, first_high, numbers[frame], job->seed_low, job->seed_high);
    floatv jitter[4];
% if jittered:
    const Words words = words_at(&at, ${streams["stare_frame"]}u, 0u);
    const uintv w[4] = {words.a, words.b, words.c, words.d};
    normal_pair(w, jitter);
    normal_pair(w + 2, jitter + 2);
% endif
    floatv lost = (floatv)0.0f;
% if pointing:
    for (uint i = 0; i < ${width}u; i++) {
        const uint row = least(most(item * ${width}u + i, start_row), stop_row - 1u) - start_row;
        ((float *)&lost)[i] = losses[(size_t)row * stare_job->padded_frames + frame];
    }
% endif
    const Strengths strengths = strengths_of(STARE_PASSED, frame, jitter, unknown, lost);
% if spectra:
    /* Flares per stare, or common to all; lanes outside the wanted range use the nearest row. */
    floatv flare[${scenarios}][${spectra}];
    const uint rows = stare_job->flare_rows, amplitude_rows = stare_job->amplitude_rows;
    for (uint i = 0; i < ${width}u; i++) {
        const uint row = least(most(item * ${width}u + i, start_row), stop_row - 1u) - start_row;
        __global const float *from = flares + (size_t)(rows > 1u ? row : 0u) * ${spectra}u * stare_job->padded_frames + frame;
        for (uint k = 0; k < scenario_count; k++)
            for (uint j = 0; j < ${spectra}u; j++)
                ((float *)flare[k])[j * ${width}u + i] = from[j * stare_job->padded_frames]
                    * (known[8u * stare_job->padded_frames + frame] * amplitudes[k * amplitude_rows + (amplitude_rows > 1u ? row : 0u)]);
    }
    for (uint k = 0; k < scenario_count; k++)
        for (uint j = 0; j < ${spectra}u; j++) flare[k][j] = FMA(strengths.light, flare[k][j], flare[k][j]);
% endif
    floatv sum[${scenarios}][${sums}][${parts}];
    for (uint k = 0; k < scenario_count; k++)
        for (uint s = 0; s < ${sums}u; s++)
            for (uint j = 0; j < ${parts}u; j++) sum[k][s][j] = (floatv)0.0f;

    /* Pixels outside of this range have no weight. */
    for (uint start = first_pixel; start < stop_pixel; start += CHUNK) {
        Draws drawn;
        draw(SCENE_PASSED, &at, 0u, start, &drawn);
        for (uint k = 0; k < scenario_count; k++) {
            floatv x[${chunk}];
            for (uint i = 0; i < CHUNK; i++) {
                __global const Mixture *m = mixtures + start + i;
                const floatv z = drawn.z[i], zz = z * z;
                floatv light = FMA(strengths.star, (floatv)m->star, strengths.sky * m->sky);
% if neighbours:
                light = FMA(strengths.neighbours, (floatv)m->neighbours, light);
% endif
% for j in range(spectra):
                light = FMA(flare[k][${j}], (floatv)spectra[${j}u * padded + start + i], light);
% endfor
                const floatv variance = FMA(light, (floatv)m->photon_variance, FMA(strengths.dark, (floatv)m->dark_variance, (floatv)m->variance));
                floatv third = FMA(strengths.dark, (floatv)m->dark_third, (floatv)m->third);
                floatv fourth = FMA(strengths.dark, (floatv)m->dark_fourth, (floatv)m->fourth);
                floatv fifth = FMA(strengths.dark, (floatv)m->dark_fifth, (floatv)m->fifth);
% if counts:
                third = FMA(light, (floatv)m->photon_third, third);
                fourth = FMA(light, (floatv)m->photon_fourth, fourth);
                fifth = FMA(light, (floatv)m->photon_fifth, fifth);
% endif
                /* The expansion of analogue() for factors on light and dark. */
                const floatv sd = root(variance), each = 1.0f / variance, skew = third * each;
                const floatv curve = fourth * FMA(zz, (floatv)0.041666668f, (floatv)-0.125f)
                                   - third * skew * FMA(zz, (floatv)0.055555556f, (floatv)-0.1388889f);
                floatv even = fifth * FMA(zz, FMA(zz, (floatv)0.008333334f, (floatv)-0.05f), (floatv)0.025f);
                even = even - skew * fourth * FMA(zz, FMA(zz, (floatv)0.041666668f, (floatv)-0.20833333f), (floatv)0.083333336f);
                even = even + skew * skew * third * FMA(zz, FMA(zz, (floatv)0.037037037f, (floatv)-0.16358025f), (floatv)0.052469134f);
                const floatv straight = FMA(curve * each, sd * each, sd);
                floatv v = FMA(z, straight, FMA(skew, FMA(zz, (floatv)0.16666667f, (floatv)-0.16666667f), (floatv)m->rest));
                v = FMA(even * each, each, v);
                v += FMA(strengths.dark, (floatv)m->dark, light);
% for name in additive:
                v = FMA(drawn.${name}[i], (floatv)pixels[start + i].electron_gain, v);
% endfor
                x[i] = digitise(v, edges + start + i) - MAGIC;
            }
% for s in range(sums):
            {
                __global const float *weight = weights + ${s}u * padded + start;
                floatv ${", ".join(f"s{j} = sum[k][{s}][{j}]" for j in range(parts))};
                for (uint i = 0; i < CHUNK; i += ${parts}u) {
% for j in range(parts):
                    s${j} = FMA(x[i + ${j}u], (floatv)weight[i + ${j}u], s${j});
% endfor
                }
                ${" ".join(f"sum[k][{s}][{j}] = s{j};" for j in range(parts))}
            }
% endfor
        }
    }
    __global float *out = values + (size_t)get_global_id(1) * scenario_count * ${sums}u * stride + item * ${width}u;
    for (uint k = 0; k < scenario_count; k++)
        for (uint s = 0; s < ${sums}u; s++)
            STORE(((sum[k][s][0] + sum[k][s][1]) + (sum[k][s][2] + sum[k][s][3])) + constants[s], out + (k * ${sums}u + s) * stride);
}
