## Differences between compilers: vectors of WIDTH realisations, and expressions that PoCL's compiler translates to
## single vector instructions. Both branches give the same bits.
<%
    lanes = [""] if width == 1 else [f".s{lane:x}" for lane in range(width)]
    w = "" if width == 1 else str(width)
    half = width // 2
    def per_lane(pattern):
        values = ", ".join(pattern.replace("@", lane) for lane in lanes)
        return values if width == 1 else f"(float{w})({values})"
%>\
#pragma OPENCL FP_CONTRACT OFF

#define INLINE static inline __attribute__((always_inline))

typedef uint${w} uintv;
typedef int${w} intv;
typedef float${w} floatv;
#define AS_UINT as_uint${w}
#define AS_INT as_int${w}
#define AS_FLOAT as_float${w}
% if width == 1:
#define LANE_INDEX ((uintv)0)
% else:
#define LANE_INDEX ((uintv)(${", ".join(f"{lane}u" for lane in range(width))}))
% endif

% if vector_forms:
/* Here a built-in on a 16-vector is a function call that spills every register. Expressions per lane are fused into one
   instruction, and operators never call. */
#define FMA(a, b, c) fused((a), (b), (c))
% if width == 16:
#ifdef __AVX512F__
/* One operation for the compiler instead of sixteen halves the compile time. */
INLINE floatv fused(floatv a, floatv b, floatv c) { return __builtin_ia32_vfmaddps512_mask(a, b, c, (unsigned short)0xffff, 4); }
INLINE floatv root(floatv a) { return __builtin_ia32_sqrtps512(a, 4); }
#else
% endif
INLINE floatv fused(floatv a, floatv b, floatv c) { return ${per_lane("__builtin_fmaf(a@, b@, c@)")}; }
INLINE floatv root(floatv a) { return ${per_lane("__builtin_sqrtf(a@)")}; }
% if width == 16:
#endif
% endif
#define TO_FLOAT(x) __builtin_convertvector((x), floatv)
#define TO_INT(x) __builtin_convertvector((x), intv)

/* 32 x 32 -> 64 bit products of even and odd lanes, interleaved by a shuffle. */
INLINE void multiply(uint factor, uintv x, uintv *high, uintv *low)
{
    ulong${half} even = (as_ulong${half}(x) & (ulong${half})0xffffffffUL) * (ulong${half})factor;
    ulong${half} odd = (as_ulong${half}(x) >> (ulong${half})32UL) * (ulong${half})factor;
    *low = __builtin_shufflevector(as_uint${w}(even), as_uint${w}(odd), ${", ".join(f"{i}, {i + width}" for i in range(0, width, 2))});
    *high = __builtin_shufflevector(as_uint${w}(even), as_uint${w}(odd), ${", ".join(f"{i + 1}, {i + 1 + width}" for i in range(0, width, 2))});
}
% else:
#define FMA(a, b, c) fma((a), (b), (c))
INLINE floatv root(floatv a) { return sqrt(a); }
#define TO_FLOAT(x) convert_float${w}(x)
#define TO_INT(x) convert_int${w}_rtz(x)
INLINE void multiply(uint factor, uintv x, uintv *high, uintv *low)
{
    *high = mul_hi((uintv)factor, x);
    *low = (uintv)factor * x;
}
% endif

/* The ternary operator works per lane and is never a call. */
#define least(a, b) ((a) < (b) ? (a) : (b))
#define most(a, b) ((a) > (b) ? (a) : (b))

INLINE uintv look_up(__global const uint *table, uintv index)
{
% if width == 1:
    return table[index];
% elif vector_forms and width == 16:
#ifdef __AVX512F__
    typedef int word16 __attribute__((ext_vector_type(16)));
    return AS_UINT(__builtin_ia32_gathersiv16si((intv)0, (const void *)(size_t)table, AS_INT(index), (unsigned short)0xffff, 4));
#else
    return (uintv)(${", ".join(f"table[index{lane}]" for lane in lanes)});
#endif
% else:
    return (uintv)(${", ".join(f"table[index{lane}]" for lane in lanes)});
% endif
}

/* Nearest integer, ties to even, for |x| < 2^22: the bits of rint() without a call. */
INLINE floatv nearest(floatv x) { return (x + 12582912.0f) - 12582912.0f; }
% if width == 1:
#define LOAD(pointer) (*(pointer))
#define STORE(value, pointer) (*(pointer) = (value))
% else:
#define LOAD(pointer) vload${width}(0, (pointer))
#define STORE(value, pointer) vstore${width}((value), 0, (pointer))
% endif
