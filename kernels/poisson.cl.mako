## Poisson counts by an exact integer alias table: one word, one look-up, no rejection.
/* Entry = alias << (32 - bits) | threshold. The word's top bits choose the column, the rest accept it
   or take its alias. The outcome is a column number; the caller adds the table's lowest count. */
INLINE uintv alias_draw(uintv word, __global const uint *table, uint bits)
{
    uint shift = 32u - bits;
    uintv column = word >> (uintv)shift;
    uintv entry = look_up(table, column);
    uintv mask = (uintv)((1u << shift) - 1u);
    return (word & mask) < (entry & mask) ? column : entry >> (uintv)shift;
}
