## Box-Muller with its own polynomials, so that every device gives the same bits.
<%
    def horner(names, x):
        terms = list(reversed(names))
        text = f"(floatv){terms[0]}"
        for term in terms[1:]:
            text = f"FMA({text}, {x}, (floatv){term})"
        return text
%>\
/* Two standard normals from two words. The radius comes from (word + 1/2) / 2^32, so that small words
   keep all their digits: |z| reaches 6.76 and no word gives an infinity. */
INLINE void normal_pair(uintv radius_word, uintv angle_word, floatv *z0, floatv *z1)
{
    floatv t = TO_FLOAT(radius_word) + 0.5f;
    uintv bits = AS_UINT(t) - (uintv)0x3f3504f3u;                  /* split at sqrt(1/2) */
    floatv halvings = TO_FLOAT((intv)32 - (AS_INT(bits) >> 23));
    floatv f = AS_FLOAT((bits & (uintv)0x007fffffu) + (uintv)0x3f3504f3u) - 1.0f;
    floatv q = ${horner(polynomials["log"], "f")};
    floatv radius = root(FMA(halvings, (floatv)${two_ln2}, f * q));  /* sqrt(-2 ln u) */

    /* The top bit turns by pi, the other 31 choose an angle in [-pi/2, pi/2). */
    floatv s = TO_FLOAT(AS_INT(angle_word << 1)) * 2.3283064365386963e-10f;
    floatv y = s * s;
    floatv sine = s * (${horner(polynomials["sin"], "y")});
    floatv cosine = ${horner(polynomials["cos"], "y")};
    radius = AS_FLOAT(AS_UINT(radius) ^ (angle_word & (uintv)0x80000000u));
    *z0 = radius * cosine;
    *z1 = radius * sine;
}
