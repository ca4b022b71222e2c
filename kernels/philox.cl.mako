## Philox4x32-10 (Salmon et al. 2011, doi 10.1145/2063384.2063405), addressed by counter.
## counter = (realisation low, realisation high, frame, stream << 24 | pixel group); key = the 64-bit seed.
#define PHILOX_M0 0xD2511F53u
#define PHILOX_M1 0xCD9E8D57u
#define PHILOX_W0 0x9E3779B9u
#define PHILOX_W1 0xBB67AE85u

typedef struct { uintv a, b, c, d; } Words;

/* Unrolled by the template, because not every compiler obeys an unroll pragma. */
#define PHILOX_ROUND(r) \
    multiply(PHILOX_M0, c0, &high0, &low0); \
    multiply(PHILOX_M1, c2, &high1, &low1); \
    c0 = high1 ^ c1 ^ (uintv)(k0 + r##u * PHILOX_W0); \
    c1 = low1; \
    c2 = high0 ^ c3 ^ (uintv)(k1 + r##u * PHILOX_W1); \
    c3 = low0;

INLINE Words rounds_3_to_9(uintv c0, uintv c1, uintv c2, uintv c3, uint k0, uint k1)
{
    uintv high0, low0, high1, low1;
% for r in range(3, 10):
    PHILOX_ROUND(${r})
% endfor
    Words out = {c0, c1, c2, c3};
    return out;
}

INLINE Words philox(uintv c0, uintv c1, uintv c2, uintv c3, uint k0, uint k1)
{
    uintv high0, low0, high1, low1;
% for r in range(3):
    PHILOX_ROUND(${r})
% endfor
    return rounds_3_to_9(c0, c1, c2, c3, k0, k1);
}

/* Only the last counter word differs between pixels. The contribution of the others to the first three rounds is
   computed once per realisation and frame, which leaves 16 of the 20 products in the loop. */
typedef struct { uintv first, e, f; uint s1, s3; uint k0, k1; } Address;

INLINE Address address(uintv realisation, uint realisation_high, uint frame, uint k0, uint k1)
{
    Address at;
    uintv high, low, high2, low2;
    multiply(PHILOX_M0, realisation, &high, &low);
    at.first = high ^ (uintv)k1;
    ulong p1 = (ulong)PHILOX_M1 * frame;
    uint x0 = (uint)(p1 >> 32) ^ realisation_high ^ k0;
    at.s1 = (uint)p1 ^ (k0 + PHILOX_W0);
    ulong p0 = (ulong)PHILOX_M0 * x0;
    uintv y2 = (uintv)(uint)(p0 >> 32) ^ low ^ (uintv)(k1 + PHILOX_W1);
    multiply(PHILOX_M1, y2, &high2, &low2);
    at.e = high2 ^ (uintv)(k0 + 2u * PHILOX_W0);
    at.f = low2;
    at.s3 = (uint)p0 ^ (k1 + 2u * PHILOX_W1);
    at.k0 = k0;
    at.k1 = k1;
    return at;
}

INLINE Words words_at(const Address *at, uint stream, uint group)
{
    uintv high, low, high0, low0;
    uintv x2 = at->first ^ (uintv)(stream << 24 | group);
    multiply(PHILOX_M1, x2, &high, &low);
    uintv y0 = high ^ (uintv)at->s1;
    multiply(PHILOX_M0, y0, &high0, &low0);
    return rounds_3_to_9(at->e ^ low, at->f, high0 ^ (uintv)at->s3, low0, at->k0, at->k1);
}

/* Two interleaved groups: each is one long chain of dependent operations, and a processor looks only a limited number
   of instructions ahead. */
INLINE void words_of_two(const Address *at, uint stream, uint group, uintv *w)
{
    uintv h[2], l[2], h0[2], l0[2], c0[2], c1[2], c2[2], c3[2];
    const uint k0 = at->k0, k1 = at->k1;
% for i in range(2):
    c2[${i}] = at->first ^ (uintv)(stream << 24 | (group + ${i}u));
    multiply(PHILOX_M1, c2[${i}], h + ${i}, l + ${i});
% endfor
% for i in range(2):
    multiply(PHILOX_M0, h[${i}] ^ (uintv)at->s1, h0 + ${i}, l0 + ${i});
    c0[${i}] = at->e ^ l[${i}]; c1[${i}] = at->f; c2[${i}] = h0[${i}] ^ (uintv)at->s3; c3[${i}] = l0[${i}];
% endfor
% for r in range(3, 10):
% for i in range(2):
    multiply(PHILOX_M0, c0[${i}], h0 + ${i}, l0 + ${i});
% endfor
% for i in range(2):
    multiply(PHILOX_M1, c2[${i}], h + ${i}, l + ${i});
% endfor
% for i in range(2):
    c0[${i}] = h[${i}] ^ c1[${i}] ^ (uintv)(k0 + ${r}u * PHILOX_W0);
    c1[${i}] = l[${i}];
    c2[${i}] = h0[${i}] ^ c3[${i}] ^ (uintv)(k1 + ${r}u * PHILOX_W1);
    c3[${i}] = l0[${i}];
% endfor
% endfor
% for i in range(2):
    w[${4 * i}] = c0[${i}]; w[${4 * i + 1}] = c1[${i}]; w[${4 * i + 2}] = c2[${i}]; w[${4 * i + 3}] = c3[${i}];
% endfor
}
