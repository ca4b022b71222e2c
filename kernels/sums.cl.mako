## What the kernels of a detection add up in.
/* Four sums side by side, by pixel number modulo four: one alone would wait for each addition to end. */
typedef struct { floatv a, b, c, d; } Four;
#define NOTHING (Four){(floatv)0.0f, (floatv)0.0f, (floatv)0.0f, (floatv)0.0f}
#define SUM(x) (((x).a + (x).b) + ((x).c + (x).d))
