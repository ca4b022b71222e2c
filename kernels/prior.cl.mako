## Factors from tables of quantiles; see mauvecl/noise/disturbances.py.
/* Factor of a prior, minus one, at the probability that a word represents. The top bit chooses an end of the table. The
   other 31 bits and 23 finer ones give the probability from that end times 2^32; octave and cell are bits of its float. */
INLINE floatv quantile(uintv word, uintv finer, __global const float *table)
{
    intv side = AS_INT(word) >> 31;
    floatv within = (TO_FLOAT(AS_INT(finer & (uintv)0x7fffffu)) + 0.5f) * ${2.0 ** -23}f;
    uintv bits = AS_UINT(TO_FLOAT(AS_INT(word) ^ side) + within) - (uintv)${(127 + 32 - prior_finest) << 23}u;
    uintv cell = (bits >> (uintv)${23 - prior_bits}u) + (AS_UINT(side) & (uintv)${prior_nodes}u);
    floatv part = TO_FLOAT(AS_INT(bits & (uintv)${2 ** (23 - prior_bits) - 1}u)) * ${2.0 ** (prior_bits - 23)}f;
    floatv left = AS_FLOAT(look_up((__global const uint *)table, cell));
    floatv right = AS_FLOAT(look_up((__global const uint *)table, cell + (uintv)1u));
    return FMA(part, right - left, left);
}

/* (1 + a) (1 + b) - 1 */
#define TOGETHER(a, b) FMA((a), (b), (a) + (b))
