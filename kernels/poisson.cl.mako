## Poisson counts relative to a whole number near their mean (METHODS section 4).
/* Draw from an exact integer alias table: one word, one look-up, no rejection.
   Entry = alias << (32 - bits) | threshold. The top bits of the word choose a column; the others accept it or take its
   alias. */
INLINE uintv alias_draw(uintv word, __global const uint *table, uint bits)
{
    uint shift = 32u - bits;
    uintv column = word >> (uintv)shift;
    uintv entry = look_up(table, column);
    uintv mask = (uintv)((1u << shift) - 1u);
    return (word & mask) < (entry & mask) ? column : entry >> (uintv)shift;
}

/* Draw by the Cornish-Fisher expansion of the quantile, for means of at least a thousand, where no feasible number
   of draws distinguishes it from the exact distribution:
   n = nearest(mean + sqrt(mean) z + (z^2 - 1) / 6 - z (z^2 + 2) / (72 sqrt(mean))). */
INLINE floatv expansion_draw(floatv z, float offset, float slope, float cubic)
{
    floatv curve = FMA(z, (floatv)cubic, (floatv)0.16666667f);
    return nearest(FMA(z, FMA(z, curve, (floatv)slope), (floatv)offset));
}

/* Counts of two neighbours from two words: a table uses one word per count, the expansion uses both words for both.
   No pair mixes the two methods (mauvecl/noise/scene.py: _both_of_a_pair), because a word used twice would correlate the counts.
   Only a padded neighbour, which has no effect, may differ. */
INLINE void poisson_pair(uintv first, uintv second, __global const Poisson *a, __global const Poisson *b,
                         __global const uint *tables, floatv *out)
{
    const uintv w[2] = {first, second};
    floatv z[2] = {(floatv)0.0f, (floatv)0.0f};
    if (!a->bits || !b->bits) normal_pair(w, z);
    out[0] = a->bits ? TO_FLOAT(AS_INT(alias_draw(first, tables + a->table, a->bits)) + (intv)a->low)
                     : expansion_draw(z[0], a->offset, a->slope, a->cubic);
    out[1] = b->bits ? TO_FLOAT(AS_INT(alias_draw(second, tables + b->table, b->bits)) + (intv)b->low)
                     : expansion_draw(z[1], b->offset, b->slope, b->cubic);
}
