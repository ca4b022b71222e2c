## Draws of pixels (METHODS section 2). A draw is one frame, or one stack of frames.
#define CHUNK ${chunk}u
#define MAGIC ${magic}
#define REFERENCE ${reference}u

/* Input buffers of a launch; helper functions take the pointers without `restrict`. */
#define POINTERS(r) __global const Job *r job, __global const Pixel *r pixels, __global const Level *r levels, \
    __global const Edge *r edges, __global const Poisson *r darks, __global const Poisson *r photon_counts, \
    __global const Response *r responses, __global const uint *r tables, __global const float *r priors
#define SCENE POINTERS(restrict)
#define SCENE_GIVEN POINTERS()
#define SCENE_PASSED job, pixels, levels, edges, darks, photon_counts, responses, tables, priors

/* Draws for CHUNK neighbouring pixels: normals, and counts that the recipe draws separately. */
typedef struct {
    floatv z[${chunk}];
% if not joint:
    floatv dark[${chunk}];
% endif
% if photons:
    uintv photon[${chunk}];
% endif
% for name in additive:
    floatv ${name}[${chunk}];
% endfor
} Draws;

<% skies = any(factor == "sky" for _, factor in modulations) %>\
/* Factors on light, dark and sky of one draw, minus one. */
typedef struct { floatv light, dark${", sky" if skies else ""}; } Factors;

/* Words and normals are separate loops: each is a long chain of dependent operations, and only short loop bodies
   with independent iterations keep the pipelines filled. */
INLINE void draw_words(const Address *at, uint stream, uint group, uintv *w)
{
% if chunk % 8 == 0:
    for (uint i = 0; i < CHUNK; i += 8u) words_of_two(at, stream, group + i / 4u, w + i);
% else:
    for (uint i = 0; i < CHUNK; i += 4u) {
        Words x = words_at(at, stream, group + i / 4u);
        w[i] = x.a; w[i + 1u] = x.b; w[i + 2u] = x.c; w[i + 3u] = x.d;
    }
% endif
}

INLINE void normals(const uintv *w, floatv *z)
{
% if chunk % 8 == 0:
    for (uint i = 0; i < CHUNK; i += 8u) four_normal_pairs(w + i, z + i);
% else:
    for (uint i = 0; i < CHUNK; i += 2u) normal_pair(w + i, z + i);
% endif
}

/* `exposure` is 0 for the observed exposure and REFERENCE for a reference; `start` is a multiple of four. */
INLINE void draw(SCENE_GIVEN, const Address *at, uint exposure, uint start, Draws *out)
{
    const uint group = job->first_group + start / 4u;
    uintv w[${chunk}];
    draw_words(at, exposure + ${streams["noise"]}u, group, w);
    normals(w, out->z);
% if not joint:
    draw_words(at, exposure + ${streams["dark"]}u, group, w);
    for (uint i = 0; i < CHUNK; i += 2u) poisson_pair(w[i], w[i + 1u], darks + start + i, darks + start + i + 1u, tables, out->dark + i);
% endif
% if photons:
    draw_words(at, exposure + ${streams["photon"]}u, group, out->photon);
% endif
% for name in additive:
    draw_words(at, exposure + ${streams[name]}u, group, w);
    for (uint i = 0; i < CHUNK; i++)
        out->${name}[i] = TO_FLOAT(AS_INT(alias_draw(w[i], tables + job->${name}_table, job->${name}_bits)) + (intv)job->${name}_low);
% endfor
}

/* Factors of a realisation, minus one, common to all its frames and pixels. */
INLINE Factors factors_of(SCENE_GIVEN, uintv realisation, uint realisation_high)
{
    Factors f = {(floatv)0.0f, (floatv)0.0f${", (floatv)0.0f" if skies else ""}};
% if modulated:
    const Address at = address(realisation, realisation_high, 0u, job->seed_low, job->seed_high);
    Words w;
    floatv one;
% for number, (name, factor) in enumerate(modulations):
% if name != "jitter":
    w = words_at(&at, ${streams[name]}u, 0u);
    one = quantile(w.a, w.b, priors + ${2 * number * prior_nodes}u);
    f.${factor} = TOGETHER(f.${factor}, one);
% endif
% endfor
% endif
    return f;
}

/* Pointing factor on the light of one frame, or the mean over a stack of frames, minus one. */
INLINE floatv kept(SCENE_GIVEN, uintv realisation, uint realisation_high, uint exposure, uint frame)
{
% if jitter is not None:
    __global const float *table = priors + ${2 * jitter * prior_nodes}u;
    floatv sum = 0.0f;
    const uint first = job->first_frame + frame, end = ${"first + 1u" if frames else "first + job->frame_count"};
    for (uint block = first / 4u; block * 4u < end; block++) {
        /* Four frames share a block of words; the low bits of the next word refine each word. */
        const Address at = address(realisation, realisation_high, block, job->seed_low, job->seed_high);
        const Words w = words_at(&at, exposure + ${streams["jitter"]}u, 0u);
        const uintv word[5] = {w.a, w.b, w.c, w.d, w.a};
        for (uint i = 0; i < 4u; i++)
            if (block * 4u + i >= first && block * 4u + i < end) sum += quantile(word[i], word[i + 1u], table);
    }
    return ${"sum" if frames else "sum * (1.0f / (float)job->frame_count)"};
% else:
    return (floatv)0.0f;
% endif
}

/* Analogue count above the level's base; level = levels + at, at = scenario * padded_count + pixel. */
INLINE floatv analogue(SCENE_GIVEN, const Draws *drawn, uint i, __global const Level *level, uint pixel, uint at, const Factors *factors)
{
    floatv z = drawn->z[i];
% if modulated:
    __global const Response *r = responses + at;
% if skies:
    /* Factors on all light apply to the sky too. */
    const floatv changed = factors->sky * (floatv)r->sky_share, more = TOGETHER(factors->light, changed);
% else:
    const floatv more = factors->light;
% endif
    floatv light = more + 1.0f, dark = factors->dark + 1.0f;
    floatv variance = FMA(light, (floatv)r->light_variance, FMA(dark, (floatv)r->dark_variance, (floatv)r->other_variance));
    floatv third = FMA(light, (floatv)r->light_third, dark * r->dark_third);
    floatv fourth = FMA(light, (floatv)r->light_fourth, dark * r->dark_fourth);
    floatv sd = root(variance), skew = third / variance, zz = z * z;
    /* z + k3 (z^2 - 1) / (6 s^3) + k4 (z^3 - 3 z) / (24 s^4) - k3^2 (2 z^3 - 5 z) / (36 s^6), all times s */
    floatv cubic = (fourth * FMA(zz, (floatv)0.041666668f, (floatv)-0.125f) - third * skew * FMA(zz, (floatv)0.055555556f, (floatv)-0.1388889f)) / (variance * sd);
    floatv v = FMA(z, sd + cubic, FMA(skew, FMA(zz, (floatv)0.16666667f, (floatv)-0.16666667f), (floatv)level->c0));
% if quartic:
    /* k5 (z^4 - 6 z^2 + 3) / (120 s^5) - k3 k4 (z^4 - 5 z^2 + 2) / (24 s^7) + k3^3 (12 z^4 - 53 z^2 + 17) / (324 s^9) */
    floatv fifth = FMA(light, (floatv)r->light_fifth, dark * r->dark_fifth);
    floatv even = fifth * FMA(zz, FMA(zz, (floatv)0.008333334f, (floatv)-0.05f), (floatv)0.025f);
    even = even - skew * fourth * FMA(zz, FMA(zz, (floatv)0.041666668f, (floatv)-0.20833333f), (floatv)0.083333336f);
    even = even + skew * skew * third * FMA(zz, FMA(zz, (floatv)0.037037037f, (floatv)-0.16358025f), (floatv)0.052469134f);
    v += even / (variance * variance);
% endif
    v += FMA(more, (floatv)r->light, factors->dark * r->dark);
% elif joint:
% if quartic:
    floatv v = FMA(z, (floatv)level->c4, (floatv)level->c3);
    v = FMA(z, v, (floatv)level->c2);
% else:
    floatv v = FMA(z, (floatv)level->c3, (floatv)level->c2);
% endif
    v = FMA(z, v, (floatv)level->c1);
    v = FMA(z, v, (floatv)level->c0);
% else:
    floatv v = FMA(z, (floatv)level->c1, (floatv)level->c0);
    v = FMA(drawn->dark[i], (floatv)darks[pixel].gain, v);
% endif
% if photons:
    /* Counts from a normal use both words of a pair. */
    floatv both[2];
    poisson_pair(drawn->photon[i & ~1u], drawn->photon[i | 1u], photon_counts + (at & ~1u), photon_counts + (at | 1u), tables, both);
    v = FMA(both[i & 1u], (floatv)photon_counts[at].gain, v);
% endif
% for name in additive:
    v = FMA(drawn->${name}[i], (floatv)pixels[pixel].electron_gain, v);
% endfor
    return v;
}

/* 1 if whole number a exceeds whole number b, else 0. */
#define PASSED(a, b) least(most((a) - (b), (floatv)0.0f), (floatv)1.0f)

/* Output of the ADC: MAGIC + whole DN above the base, clipped to its range. */
INLINE floatv digitise(floatv v, __global const Edge *edge)
{
    floatv r = v + MAGIC;
% if clip:
    r = least(most(r, (floatv)edge->low), (floatv)edge->high);
% endif
    return r;
}

<% sums = "+=" if frames else "=" %>\
/* State common to all pixels of a draw. */
typedef struct { Address at; Factors factors; } Shared;

/* Exposure of a vector of realisations: the observed one, or the reference with index `number`. */
typedef struct {
    uintv realisation;
    uint realisation_high, which, number;
    Factors steady;
% if not frames:
    Shared only;
% endif
} Exposure;

INLINE Shared shared_of(SCENE_GIVEN, const Exposure *x, uint draw_number)
{
    Shared s;
    s.at = address(x->realisation, x->realisation_high, job->first_frame + draw_number, job->seed_low, job->seed_high);
    s.factors = x->steady;
    const uint frame = draw_number${"" if frames else " * job->frame_count"};
    s.factors.light = TOGETHER(s.factors.light, kept(SCENE_PASSED, x->realisation, x->realisation_high, x->which, frame));
    return s;
}

/* Another exposure of the same realisations. */
INLINE Exposure another(SCENE_GIVEN, Exposure x, uint which, uint number)
{
    x.which = which;
    x.number = number;
% if not frames:
    x.only = shared_of(SCENE_PASSED, &x, number);
% endif
    return x;
}

INLINE Exposure observed(SCENE_GIVEN, uintv realisation, uint realisation_high)
{
    Exposure x;
    x.realisation = realisation;
    x.realisation_high = realisation_high;
    x.steady = factors_of(SCENE_PASSED, realisation, realisation_high);
    return another(SCENE_PASSED, x, 0u, 0u);
}

/* Draw an exposure of CHUNK pixels from `start` on: whole DN above the base of scenarios `first` to `end` - 1, summed
   over its draws. If `cut` is given, count the clipped draws, low and high, in `cut`, with a stride of `apart` per
   pixel. */
INLINE void expose(SCENE_GIVEN, const Exposure *x, uint start, uint first, uint end, intv (*counts)[${chunk}], uintv (*cut)[2], uint apart)
{
% if frames:
    for (uint k = first; k < end; k++)
        for (uint i = 0; i < CHUNK; i++) counts[k - first][i] = 0;
% endif
    for (uint n = 0; n < ${"job->draw_count" if frames else "1u"}; n++) {
        const Shared shared = ${"shared_of(SCENE_PASSED, x, x->number * job->draw_count + n)" if frames else "x->only"};
        Draws drawn;
        draw(SCENE_PASSED, &shared.at, x->which, start, &drawn);
        for (uint k = first; k < end; k++)
            for (uint i = 0; i < CHUNK; i++) {
                const uint here = k * job->padded_count + start + i;
                const floatv v = analogue(SCENE_PASSED, &drawn, i, levels + here, start + i, here, &shared.factors);
                const floatv r = digitise(v, edges + here);
                counts[k - first][i] ${sums} AS_INT(r) - AS_INT((floatv)MAGIC);
% if clip:
                if (cut) {
                    cut[i * apart][0] += AS_UINT(TO_INT(PASSED(r, v + MAGIC)));
                    cut[i * apart][1] += AS_UINT(TO_INT(PASSED(v + MAGIC, r)));
                }
% endif
            }
    }
}
