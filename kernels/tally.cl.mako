## Histograms and integer sums of whole channels. A channel belongs to one work-item, so nothing is
## atomic and every sum is of integers: no order, tile or device can change it.
__kernel
void tally(const uint from, const uint to, const uint stride, __global const float *restrict values,
           __global const Grid *restrict grids, __global uint *restrict histogram, __global long *restrict sums)
{
    const uint g = get_global_id(0);
    const Grid grid = grids[g];
    __global const float *row = values + (size_t)grid.channel * stride;
    __global uint *bins = histogram + (size_t)g * ${bins}u;
    long first = 0, second = 0;
    for (uint i = from; i < to; i++) {
        /* Whole fine steps from the grid's centre; far values are held at the ends, and counted there. */
        float steps = (row[i] - grid.centre) * grid.steps_per_unit;
        steps = steps < -${limit}.0f ? -${limit}.0f : steps;
        steps = steps > ${limit}.0f ? ${limit}.0f : steps;
        int step = (int)((steps + 12582912.0f) - 12582912.0f);
        first += step;
        second += (long)step * step;
        int bin = (step >> ${fine_bits}) + ${bins // 2};
        bin = bin < 0 ? 0 : bin;
        bin = bin > ${bins - 1} ? ${bins - 1} : bin;
        bins[bin]++;
    }
    sums[2u * g] += first;
    sums[2u * g + 1u] += second;
}
