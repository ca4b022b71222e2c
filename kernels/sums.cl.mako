## Accumulators of the detection kernels.
/* Four partial sums by pixel index modulo four, since a single sum would wait for each addition. */
typedef struct { floatv a, b, c, d; } Four;
#define NOTHING (Four){(floatv)0.0f, (floatv)0.0f, (floatv)0.0f, (floatv)0.0f}
#define SUM(x) (((x).a + (x).b) + ((x).c + (x).d))
