## Frames of stares. Only the strengths of a few spectra vary between frames and stares; see
## mauvecl/flares/frames.py. Vector lanes are stares if pixels are drawn, and frames if sums are drawn.
#define STARE_POINTERS(r) __global const StareJob *r stare_job, __global const uint *r numbers, __global const float *r known, \
    __global const float *r curves, __global const uint *r kinds, __global const float *r flares, __global const float *r amplitudes, \
    __global const float *r losses
#define STARE STARE_POINTERS(restrict)
#define STARE_GIVEN STARE_POINTERS()
#define STARE_PASSED stare_job, numbers, known, curves, kinds, flares, amplitudes, losses

% if in_time:
#define OF_FRAME(array) LOAD((array) + frame)
#define LOST(stare) ${"OF_FRAME(losses + (size_t)(stare) * stride)" if pointing else "(floatv)0.0f"}
% else:
#define OF_FRAME(array) ((floatv)((array)[frame]))
% endif

/* Coefficients of star, sky, dark and neighbours, and the factor on all light, each minus one. */
typedef struct { floatv star, sky, dark, neighbours, light; } Strengths;

/* exp(x) - 1, for |x| < 80 */
INLINE floatv exponential_less_one(floatv x)
{
    const floatv whole = x * ${log2_e} + MAGIC, n = whole - MAGIC;
    const floatv r = FMA(n, (floatv)${-ln2_parts[1]}f, FMA(n, (floatv)${-ln2_parts[0]}f, x));
    floatv q = (floatv)${exponential[-1]};
% for term in reversed(exponential[:-1]):
    q = FMA(q, r, (floatv)${term});
% endfor
    const floatv scale = AS_FLOAT((AS_INT(whole) - AS_INT((floatv)MAGIC) + (intv)127) << 23);
    return FMA(scale, FMA(r * r, q, r), scale - 1.0f);
}

/* Amplitudes of a stare's unknowns, in standard deviations. */
INLINE void unknowns_of(const StareJob stare_job, uintv realisation, uint realisation_high, uint seed_low, uint seed_high, floatv *z)
{
    const Address at = address(realisation, realisation_high, 0u, seed_low, seed_high);
    for (uint u = 0; u < stare_job.unknown_count; u += 4u) {
        const Words x = words_at(&at, ${streams["stare_unknown"]}u, u / 4u);
        const uintv w[4] = {x.a, x.b, x.c, x.d};
        normal_pair(w, z + u);
        normal_pair(w + 2, z + u + 2u);
    }
}

INLINE Strengths strengths_of(STARE_GIVEN, uint frame, const floatv *jitter, const floatv *z, floatv lost)
{
    const uint stride = stare_job->padded_frames;
% if jittered:
    floatv moved[4] = {(floatv)0.0f, jitter[0] * stare_job->light_jitter, jitter[1] * stare_job->sky_jitter, jitter[2] * stare_job->temperature_jitter};
% else:
    floatv moved[4] = {(floatv)0.0f, (floatv)0.0f, (floatv)0.0f, (floatv)0.0f};
% endif
    for (uint u = 0; u < stare_job->unknown_count; u++) {
        const floatv more = OF_FRAME(curves + u * stride);
        for (uint kind = 0; kind < 4u; kind++)
            if (kinds[u] == kind) moved[kind] = FMA(z[u], more, moved[kind]);
    }
% if pointing:
    /* Light that the stare loses in the frame by drifts out of the fibre. */
    moved[1] = TOGETHER(moved[1], -lost);
% endif
    Strengths s;
    s.light = moved[1];
    s.star = FMA(OF_FRAME(known), TOGETHER(moved[1], moved[0]), OF_FRAME(known + stride));
    s.sky = FMA(OF_FRAME(known + 2u * stride), TOGETHER(moved[1], moved[2]), OF_FRAME(known + 3u * stride));
    s.dark = FMA(OF_FRAME(known + 4u * stride), exponential_less_one(moved[3] * stare_job->dark_slope), OF_FRAME(known + 5u * stride));
    s.neighbours = FMA(OF_FRAME(known + 6u * stride), moved[1], OF_FRAME(known + 7u * stride));
    return s;
}
