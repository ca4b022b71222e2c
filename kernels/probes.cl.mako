## Kernels that run the production code on given words, for tests and the self-test.
/* Common value of all lanes; another value if they differ. */
INLINE uint agreed(uintv word)
{
    uint lanes[${width}], differ = 0u;
    STORE(word, lanes);
    for (uint lane = 1; lane < ${width}u; lane++) differ |= lanes[lane] ^ lanes[0];
    return lanes[0] ^ differ;
}

__kernel ${attributes}
void probe_philox(const uint count, __global const uint *counters, __global const uint *keys, __global uint *out)
{
    /* Each work-item uses the same counter and key in all lanes. */
    const uint item = get_global_id(0);
    __global const uint *c = counters + 4u * item;
    Words full = philox((uintv)c[0], (uintv)c[1], (uintv)c[2], (uintv)c[3], keys[2u * item], keys[2u * item + 1u]);
    const Address at = address((uintv)c[0], c[1], c[2], keys[2u * item], keys[2u * item + 1u]);
    Words quick = words_at(&at, c[3] >> 24, c[3] & 0xffffffu);
    __global uint *o = out + 8u * item;
% for i, word in enumerate("abcd"):
    o[${i}] = agreed(full.${word});
    o[${i + 4}] = agreed(quick.${word});
% endfor
}

__kernel ${attributes}
void probe_normal(__global const uint *restrict words, __global float *restrict out)
{
    /* words[2][n] -> normals[2][n], n = WIDTH x global size */
    const uint item = get_global_id(0), n = get_global_size(0) * ${width}u;
    const uintv w[2] = {LOAD(words + item * ${width}u), LOAD(words + n + item * ${width}u)};
    floatv z[2];
    normal_pair(w, z);
    STORE(z[0], out + item * ${width}u);
    STORE(z[1], out + n + item * ${width}u);
}

__kernel ${attributes}
void probe_alias(__global const uint *restrict words, __global const uint *restrict table, const uint bits, __global uint *restrict out)
{
    const uint item = get_global_id(0);
    STORE(alias_draw(LOAD(words + item * ${width}u), table, bits), out + item * ${width}u);
}

__kernel ${attributes}
void probe_prior(__global const uint *restrict words, __global const float *restrict table, __global float *restrict out)
{
    /* words[2][n]: probabilities and their finer digits -> factors[n], minus one; n = WIDTH x global size */
    const uint item = get_global_id(0), n = get_global_size(0) * ${width}u;
    STORE(quantile(LOAD(words + item * ${width}u), LOAD(words + n + item * ${width}u), table), out + item * ${width}u);
}

__kernel void probe_layout(__global uint *restrict out)
{
    uint i = 0;
% for name, fields in structs.items():
% for field in fields:
    out[i++] = (uint)(size_t)&((${name} *)0)->${field};
% endfor
    out[i++] = (uint)sizeof(${name});
% endfor
}

/* Use every word of a work-item as radius, with one angle; return the smallest and the largest normal and the number
   of values that are not finite. */
__kernel ${attributes}
void probe_every_word(const uint per_item, const uint angle, __global float *restrict ends, __global uint *restrict bad)
{
    const uint item = get_global_id(0);
    floatv low = (floatv)0.0f, high = (floatv)0.0f;
    uintv wrong = (uintv)0u;
    for (uint i = 0; i < per_item; i += ${width}u) {
        const uintv w[2] = {(uintv)(item * per_item + i) + LANE_INDEX, (uintv)angle};
        floatv z[2];
        normal_pair(w, z);
        for (uint j = 0; j < 2u; j++) {
            low = least(low, z[j]);
            high = most(high, z[j]);
            wrong += (z[j] > -7.0f) && (z[j] < 7.0f) ? (uintv)0u : (uintv)1u;
        }
    }
    STORE(low, ends + (2u * item) * ${width}u);
    STORE(high, ends + (2u * item + 1u) * ${width}u);
    STORE(wrong, bad + item * ${width}u);
}

/* Histogram of normals from consecutive groups of a stream: counts[item][4096], bins of 1/256 from -8 on. */
__kernel ${attributes}
void probe_histogram(const uint seed, const uint groups, __global uint *restrict counts)
{
    const uint item = get_global_id(0);
    __global uint *mine = counts + 4096u * item;
    const Address at = address((uintv)(item * ${width}u) + LANE_INDEX, 0u, 0u, seed, 0u);
    for (uint group = 0; group < groups; group++) {
        const Words x = words_at(&at, ${streams["noise"]}u, group);
        const uintv w[4] = {x.a, x.b, x.c, x.d};
        floatv z[4];
        normal_pair(w, z);
        normal_pair(w + 2, z + 2);
        for (uint j = 0; j < 4u; j++) {
            int bin[${width}];
            STORE(TO_INT(FMA(z[j], (floatv)256.0f, (floatv)2048.0f)), bin);
            for (uint lane = 0; lane < ${width}u; lane++) mine[bin[lane]]++;
        }
    }
}
