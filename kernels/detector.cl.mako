## One frame, or one stack of frames, of one pixel: METHODS section 2.
/* Gaussian z of `count` neighbouring pixels from `start` on, both multiples of four. */
INLINE void draw_noise(const Address *at, uint stream, uint start, uint count, floatv *z)
{
    for (uint i = 0; i < count; i += 4) {
        Words w = words_at(at, stream, (start + i) / 4u);
        normal_pair(w.a, w.b, z + i, z + i + 1);
        normal_pair(w.c, w.d, z + i + 2, z + i + 3);
    }
}

/* Dark counts of the same pixels, relative to their tables' centres. Two loops, because one would need
   more registers than there are. */
INLINE void draw_dark(const Address *at, uint stream, uint start, uint count,
                      __global const Pixel *pixels, __global const uint *tables, floatv *d)
{
    for (uint i = 0; i < count; i += 4) {
        Words w = words_at(at, stream, (start + i) / 4u);
        __global const Pixel *pixel = pixels + start + i;
% if expansion:
        floatv g[4];
        normal_pair(w.a, w.b, g, g + 1);
        normal_pair(w.c, w.d, g + 2, g + 3);
        for (uint j = 0; j < 4u; j++)
            d[i + j] = expansion_draw(g[j], pixel[j].dark_offset, pixel[j].dark_slope, pixel[j].dark_cubic);
% else:
% for i, word in enumerate("abcd"):
        d[i + ${i}] = TO_FLOAT(AS_INT(alias_draw(w.${word}, tables + pixel[${i}].table_start, pixel[${i}].table_bits)) + (intv)pixel[${i}].dark_low);
% endfor
% endif
    }
}

/* The raw count above the level's base, rounded to whole DN and clipped to the ADC's range: exact in
   float, because everything large is in the base. */
INLINE floatv digitise(floatv z, floatv d, const float dark_gain, __global const Level *level)
{
    floatv dn = nearest(FMA((floatv)level->sd, z, FMA((floatv)dark_gain, d, (floatv)level->fraction)));
% if clip:
    dn = least(most(dn, (floatv)level->low), (floatv)level->high);
% endif
    return dn;
}
