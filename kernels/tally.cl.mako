## Histograms and integer sums of whole channels. All additions are of integers, so order, tiling and device do not
## change the result. Values outside the fine bins set the first or last bin and are counted in `outside`; the host then
## processes these values itself.
<%
    block = 16
    end = bins // 2 << fine_bits
    inner = end - (1 << fine_bits)
%>\
% if width == 1:
/* Many work-items per channel. */
#define COUNT(bin) atomic_inc(bins + (bin))
#define ADD(pointer, n) atomic_add((pointer), (n))
% else:
/* One work-item per channel. */
#define COUNT(bin) bins[bin]++
#define ADD(pointer, n) (*(pointer) += (n))
% endif
/* Whole fine steps from the grid's centre; distant values and NaN are set to the ends. */
static inline int step_of(float value, Grid grid)
{
    float steps = (value - grid.centre) * grid.steps_per_unit;
    steps = steps > -${end}.0f ? steps : -${end}.0f;
    steps = steps < ${end - 1}.0f ? steps : ${end - 1}.0f;
    return (int)((steps + 12582912.0f) - 12582912.0f);
}

static inline int bin_of(int step)
{
    return (step >> ${fine_bits}) + ${bins // 2};
}

/* The step if its bin is neither the first nor the last, else zero. */
static inline int inner_of(int step)
{
    return step >= -${inner} && step < ${inner} ? step : 0;
}

__kernel
void tally(const uint from, const uint to, const uint stride, __global const float *restrict values,
           __global const Grid *restrict grids, __global uint *restrict histogram, __global long *restrict sums,
           __global uint *restrict outside)
{
    const uint g = get_global_id(0);
    const Grid grid = grids[g];
    __global const float *row = values + (size_t)grid.channel * stride;
    __global uint *bins = histogram + (size_t)g * ${bins}u;
    long first = 0, second = 0;
    uint out = 0u;
% if width == 1:
    const uint item = get_global_id(1), items = get_global_size(1);
    for (uint i = from + item; i < to; i += items) {
% else:
    const uint item = 0u, items = 1u;
    uint i = from;
    for (; i + ${block}u <= to; i += ${block}u) {
        /* Loops of fixed length, which the compiler vectorises. */
        int step[${block}], inner[${block}];
        for (uint j = 0; j < ${block}u; j++) step[j] = step_of(row[i + j], grid);
        for (uint j = 0; j < ${block}u; j++) inner[j] = inner_of(step[j]);
        for (uint j = 0; j < ${block}u; j++) out += inner[j] != step[j];
        for (uint j = 0; j < ${block}u; j++) first += inner[j];
        for (uint j = 0; j < ${block}u; j++) second += (long)inner[j] * inner[j];
        for (uint j = 0; j < ${block}u; j++) step[j] = bin_of(step[j]);
% for j in range(block):
        COUNT(step[${j}]);
% endfor
    }
    for (; i < to; i++) {
% endif
        int step = step_of(row[i], grid), inner = inner_of(step);
        out += inner != step;
        first += inner;
        second += (long)inner * inner;
        COUNT(bin_of(step));
    }
    /* sums[channel][item][first, second] */
    __global long *mine = sums + 2u * (g * items + item);
    mine[0] += first;
    mine[1] += second;
    if (out) ADD(outside + g, out);
}
