## Philox4x32-10 (Salmon et al. 2011, doi 10.1145/2063384.2063405), addressed, never consumed in sequence.
## counter = (realisation low, realisation high, frame, stream << 24 | pixel group); key = the 64-bit seed.
#define PHILOX_M0 0xD2511F53u
#define PHILOX_M1 0xCD9E8D57u
#define PHILOX_W0 0x9E3779B9u
#define PHILOX_W1 0xBB67AE85u

typedef struct { uintv a, b, c, d; } Words;

static inline Words philox_rounds(uintv c0, uintv c1, uintv c2, uintv c3, uint k0, uint k1, int first)
{
    uintv high0, low0, high1, low1;
    /* Unrolled by the compiler: the keys are uniform, so they stay scalars. */
    #pragma unroll
    for (int r = first; r < 10; r++) {
        uint key0 = k0 + (uint)r * PHILOX_W0, key1 = k1 + (uint)r * PHILOX_W1;
        multiply(PHILOX_M0, c0, &high0, &low0);
        multiply(PHILOX_M1, c2, &high1, &low1);
        c0 = high1 ^ c1 ^ (uintv)key0;
        c1 = low1;
        c2 = high0 ^ c3 ^ (uintv)key1;
        c3 = low0;
    }
    Words out = {c0, c1, c2, c3};
    return out;
}

static inline Words philox(uintv c0, uintv c1, uintv c2, uintv c3, uint k0, uint k1)
{
    return philox_rounds(c0, c1, c2, c3, k0, k1, 0);
}

/* Only the last counter word changes from pixel to pixel. What the first three rounds make of the
   others is computed once per realisation and frame: 16 of the 20 products are left in the loop. */
typedef struct { uintv first, e, f; uint s1, s3; uint k0, k1; } Address;

static inline Address address(uintv realisation, uint realisation_high, uint frame, uint k0, uint k1)
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

static inline Words words_at(const Address *at, uint stream, uint group)
{
    uintv high, low, high0, low0;
    uintv x2 = at->first ^ (uintv)(stream << 24 | group);
    multiply(PHILOX_M1, x2, &high, &low);
    uintv y0 = high ^ (uintv)at->s1;
    multiply(PHILOX_M0, y0, &high0, &low0);
    return philox_rounds(at->e ^ low, at->f, high0 ^ (uintv)at->s3, low0, at->k0, at->k1, 3);
}
