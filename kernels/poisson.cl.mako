## Poisson counts, relative to a whole number near their mean: never a rounded normal (METHODS section 4).
/* By an exact integer alias table: one word, one look-up, no rejection. Entry = alias << (32 - bits) | threshold.
   The word's top bits choose the column, the rest accept it or take its alias. */
INLINE uintv alias_draw(uintv word, __global const uint *table, uint bits)
{
    uint shift = 32u - bits;
    uintv column = word >> (uintv)shift;
    uintv entry = look_up(table, column);
    uintv mask = (uintv)((1u << shift) - 1u);
    return (word & mask) < (entry & mask) ? column : entry >> (uintv)shift;
}

/* By the inverse's expansion in the mean (Cornish & Fisher), for means of a thousand and more, where no number
   of draws that anyone makes can tell it from the exact distribution:
   n = nearest(mean + sqrt(mean) z + (z^2 - 1) / 6 - z (z^2 + 2) / (72 sqrt(mean))). */
INLINE floatv expansion_draw(floatv z, float offset, float slope, float cubic)
{
    floatv curve = FMA(z, (floatv)cubic, (floatv)0.16666667f);
    return nearest(FMA(z, FMA(z, curve, (floatv)slope), (floatv)offset));
}

/* Counts of two neighbours from their two words: one each from tables, or both of both from the expansion. The scene
   lets no pair mix the two ways (scene.py: _both_of_a_pair), for a word used twice would tie its counts together; a
   padded neighbour alone may differ, and counts for nothing. */
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
