## Histograms of each pixel's counts and each resolution element's S/N, over realisations.
## The S/N of a pixel is a function of its count alone, so the histogram of counts contains it.
## Values outside the bins only set the first or last bin and `outside`; the host counts them from raw spectra.
% if width == 1:
/* Many work-items per element: integer additions, whose order does not matter. */
#define COUNT(pointer) atomic_inc(pointer)
#define ADD(pointer, n) atomic_add((pointer), (n))
% else:
/* One work-item per element. */
#define COUNT(pointer) (*(pointer))++
#define ADD(pointer, n) (*(pointer) += (n))
% endif

/* True for the first and the last bin. */
#define END(bin) (((bin) == 0) | ((bin) == ${observer_bins - 1}))
#define WANTED(lane) (row + (lane) >= start_row && row + (lane) < stop_row)

__kernel ${attributes}
void histogram(SCENE, const uint first_low, const uint first_high, const uint start_row, const uint stop_row,
               __global const Observer *restrict observers, __global const Element *restrict elements,
               __global uint *restrict pixel_counts, __global uint *restrict element_counts, __global uint *restrict clipped,
               __global uint *restrict outside)
{
    /* pixel_counts[pixel][bin], element_counts[element][bin], clipped[pixel][low, high] */
    const uint e = get_global_id(0);
    const Element element = elements[e];
% if width == 1:
    for (uint row = start_row + get_global_id(1); row < stop_row; row += get_global_size(1)) {
% else:
    for (uint row = start_row / ${width}u * ${width}u; row < stop_row; row += ${width}u) {
% endif
        const uintv realisation = (uintv)(first_low + row) + LANE_INDEX;
        const bool whole = row >= start_row && row + ${width}u <= stop_row;
        const Exposure observation = observed(SCENE_PASSED, realisation, first_high);
        floatv signal = 0.0f, variance = 0.0f;
        intv ended = 0;
        for (uint start = element.first & ~3u; start < element.end; start += CHUNK) {
            intv n[1][${chunk}];
            uintv cut[${chunk}][2];
% if clip:
            for (uint i = 0; i < CHUNK; i++) cut[i][0] = cut[i][1] = (uintv)0u;
% endif
            expose(SCENE_PASSED, &observation, start, 0u, 1u, n, cut, 1u);
            for (uint i = 0; i < CHUNK; i++) {
                const uint p = start + i;
                if (p < element.first || p >= element.end) continue;
                floatv net = TO_FLOAT(n[0][i]) + observers[p].net_offset;
                signal += net;
                variance += FMA(most(net, (floatv)0.0f), (floatv)observers[p].gain, (floatv)observers[p].variance);
                intv bin = (n[0][i] >> (intv)(int)observers[p].bin_shift) + ${observer_bins // 2};
                bin = least(most(bin, (intv)0), (intv)${observer_bins - 1});
                ended |= END(bin);
                int lanes[${width}];
                STORE(bin, lanes);
                __global uint *mine = pixel_counts + p * ${observer_bins}u;
                if (whole) {
% for lane in range(width):
                    COUNT(mine + lanes[${lane}]);
% endfor
                } else {
                    for (uint lane = 0; lane < ${width}u; lane++) if (WANTED(lane)) COUNT(mine + lanes[lane]);
                }
% if clip:
                uint below[${width}], above[${width}];
                STORE(cut[i][0], below);
                STORE(cut[i][1], above);
                for (uint lane = 0; lane < ${width}u; lane++) {
                    if (!WANTED(lane)) continue;
                    if (below[lane]) ADD(clipped + 2u * p, below[lane]);
                    if (above[lane]) ADD(clipped + 2u * p + 1u, above[lane]);
                }
% endif
            }
        }
        /* The sky is not signal, but its photons add noise. */
        signal -= (floatv)element.sky;
        /* The ratio is zero if the estimated noise is zero. */
        floatv ratio = variance > 0.0f ? signal / root(variance) : (floatv)0.0f;
        floatv steps = (ratio - element.centre) * element.bins_per_unit;
        steps = least(most(steps, (floatv)${-(observer_bins // 2)}.0f), (floatv)${observer_bins // 2 - 1}.0f);
        intv bin = TO_INT(nearest(steps)) + ${observer_bins // 2};
        ended |= END(bin);
        int lanes[${width}], ends[${width}];
        STORE(bin, lanes);
        STORE(ended, ends);
        for (uint lane = 0; lane < ${width}u; lane++) {
            if (!WANTED(lane)) continue;
            COUNT(element_counts + e * ${observer_bins}u + lanes[lane]);
            if (ends[lane]) ${"atomic_or(outside + e, 1u)" if width == 1 else "outside[e] = 1u"};
        }
    }
}
