## Statistics marginalised over nuisance parameters: chi-squared minus the squares of weighted sums.

/* values[base] -= sum of values[row]^2, row from first to end - 1; one vector of realisations per work-item. */
__kernel ${attributes}
void marginalise(const uint count, __global const uint *restrict bases, __global const uint *restrict firsts,
                 __global const uint *restrict ends, const uint stride, __global float *restrict values)
{
    __global float *mine = values + get_global_id(0) * ${width}u;
    for (uint c = 0; c < count; c++) {
        floatv total = LOAD(mine + (size_t)bases[c] * stride);
        for (uint row = firsts[c]; row < ends[c]; row++) {
            const floatv sum = LOAD(mine + (size_t)row * stride);
            total = FMA(-sum, sum, total);
        }
        STORE(total, mine + (size_t)bases[c] * stride);
    }
}
