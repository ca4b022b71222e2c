## One frame, or one stack of frames, of one pixel: METHODS section 2.
/* Gaussian z and dark count d (relative to the table's centre) of four neighbouring pixels. */
INLINE void draw_four(const Address *at, uint noise_stream, uint dark_stream, uint group,
                      __global const Pixel *pixels, __global const uint *tables, floatv *z, floatv *d)
{
    Words g = words_at(at, noise_stream, group);
    normal_pair(g.a, g.b, z, z + 1);
    normal_pair(g.c, g.d, z + 2, z + 3);
    Words w = words_at(at, dark_stream, group);
% for i, word in enumerate("abcd"):
    d[${i}] = TO_FLOAT(AS_INT(alias_draw(w.${word}, tables + pixels[${i}].table_start, pixels[${i}].table_bits)) + (intv)pixels[${i}].dark_low);
% endfor
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
