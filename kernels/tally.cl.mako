## Histograms and integer sums of whole channels. Everything added is a whole number: no order, tile or device can
## change a result.
<% block = 16 %>\
% if width == 1:
/* Many work-items to a channel. */
#define COUNT(bin) atomic_inc(bins + (bin))
% else:
/* A channel belongs to one work-item. */
#define COUNT(bin) bins[bin]++
% endif
/* Whole fine steps from the grid's centre; far values are held at the ends, and counted there. */
static inline int step_of(float value, Grid grid)
{
    float steps = (value - grid.centre) * grid.steps_per_unit;
    steps = steps < -${limit}.0f ? -${limit}.0f : steps;
    steps = steps > ${limit}.0f ? ${limit}.0f : steps;
    return (int)((steps + 12582912.0f) - 12582912.0f);
}

static inline int bin_of(int step)
{
    int bin = (step >> ${fine_bits}) + ${bins // 2};
    bin = bin < 0 ? 0 : bin;
    return bin > ${bins - 1} ? ${bins - 1} : bin;
}

__kernel
void tally(const uint from, const uint to, const uint stride, __global const float *restrict values,
           __global const Grid *restrict grids, __global uint *restrict histogram, __global long *restrict sums)
{
    const uint g = get_global_id(0);
    const Grid grid = grids[g];
    __global const float *row = values + (size_t)grid.channel * stride;
    __global uint *bins = histogram + (size_t)g * ${bins}u;
    long first = 0, second = 0;
% if width == 1:
    const uint share = get_global_id(1), shares = get_global_size(1);
    for (uint i = from + share; i < to; i += shares) {
% else:
    const uint share = 0u, shares = 1u;
    uint i = from;
    for (; i + ${block}u <= to; i += ${block}u) {
        /* Blocks, because a compiler makes vectors of what has a fixed length. */
        int step[${block}];
        for (uint j = 0; j < ${block}u; j++) step[j] = step_of(row[i + j], grid);
        for (uint j = 0; j < ${block}u; j++) first += step[j];
        for (uint j = 0; j < ${block}u; j++) second += (long)step[j] * step[j];
        for (uint j = 0; j < ${block}u; j++) step[j] = bin_of(step[j]);
% for j in range(block):
        COUNT(step[${j}]);
% endfor
    }
    for (; i < to; i++) {
% endif
        int step = step_of(row[i], grid);
        first += step;
        second += (long)step * step;
        COUNT(bin_of(step));
    }
    /* sums[channel][share][first, second] */
    __global long *mine = sums + 2u * (g * shares + share);
    mine[0] += first;
    mine[1] += second;
}
