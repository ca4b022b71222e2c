## Box-Muller transform with explicit polynomials, so that every device gives the same bits.
<%def name="pairs(count)">\
% for i in range(count):
    floatv t${i} = TO_FLOAT(w[${2 * i}]) + 0.5f;
    uintv bits${i} = AS_UINT(t${i}) - (uintv)0x3f3504f3u;                  /* split at sqrt(1/2) */
    floatv halvings${i} = TO_FLOAT((intv)32 - (AS_INT(bits${i}) >> 23));
    floatv f${i} = AS_FLOAT((bits${i} & (uintv)0x007fffffu) + (uintv)0x3f3504f3u) - 1.0f;
% endfor
${evaluate("q", "f", polynomials["log"], count)}\
% for i in range(count):
    floatv radius${i} = root(FMA(halvings${i}, (floatv)${two_ln2}, f${i} * q${i}));  /* sqrt(-2 ln u) */
% endfor
% for i in range(count):
    /* The top bit adds pi; the other 31 bits give an angle in [-pi/2, pi/2). */
    floatv s${i} = TO_FLOAT(AS_INT(w[${2 * i + 1}] << 1)) * 2.3283064365386963e-10f;
    floatv y${i} = s${i} * s${i};
% endfor
${evaluate("sine", "y", polynomials["sin"], count)}\
${evaluate("cosine", "y", polynomials["cos"], count)}\
% for i in range(count):
    radius${i} = AS_FLOAT(AS_UINT(radius${i}) ^ (w[${2 * i + 1}] & (uintv)0x80000000u));
    z[${2 * i}] = radius${i} * cosine${i};
    z[${2 * i + 1}] = radius${i} * (s${i} * sine${i});
% endfor
</%def>\
<%def name="evaluate(result, x, terms, count)">\
% for i in range(count):
    floatv ${result}${i} = (floatv)${terms[-1]};
% endfor
% for term in reversed(terms[:-1]):
% for i in range(count):
    ${result}${i} = FMA(${result}${i}, ${x}${i}, (floatv)${term});
% endfor
% endfor
</%def>\
/* Two standard normals z[0], z[1] from the words w[0], w[1]. The radius follows from (w[0] + 1/2) / 2^32, which keeps
   all digits of small words: |z| reaches 6.76 and is never infinite. */
INLINE void normal_pair(const uintv *w, floatv *z)
{
${pairs(1)}\
}

/* Four interleaved pairs, for the same reason as in words_of_two. */
INLINE void four_normal_pairs(const uintv *w, floatv *z)
{
${pairs(4)}\
}
