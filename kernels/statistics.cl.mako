## Every statistic of METHODS section 6 of every scenario, from one pass over common draws.
## t = observed - expected quiescent DN of one pixel; each work-item follows WIDTH realisations over all pixels.
/* Four sums side by side, by pixel number modulo four: one alone would wait for each addition to end. */
typedef struct { floatv a, b, c, d; } Four;
#define NOTHING (Four){0.0f, 0.0f, 0.0f, 0.0f}
#define SUM(x) (((x).a + (x).b) + ((x).c + (x).d))

__kernel ${attributes}
void statistics(const uint seed_low, const uint seed_high, const uint first_low, const uint first_high,
                const uint pixel_count, const uint scenario_count, const uint frame_count,
                __global const Pixel *restrict pixels, __global const Level *restrict levels,
                __global const uint *restrict tables, __global const float *restrict weights,
                __global const uint *restrict linear_end, const uint stride, __global float *restrict values)
{
    const uint item = get_global_id(0);
    const uintv realisation = (uintv)(first_low + item * ${width}u) + LANE_INDEX;
    Four chi2[${scenarios}], linear[${linears}];
    floatv element[${scenarios}], chi2_element[${scenarios}];
% if pair:
    floatv chi2_pair[${scenarios}];
% endif
    for (uint k = 0; k < scenario_count; k++) {
        chi2[k] = NOTHING; element[k] = 0.0f; chi2_element[k] = 0.0f;
% if pair:
        chi2_pair[k] = 0.0f;
% endif
    }
    for (uint l = 0; l < linear_end[scenario_count - 1]; l++) linear[l] = NOTHING;
% if not frames:
    const Address at = address(realisation, first_high, 0u, seed_low, seed_high);
% endif

    for (uint start = 0; start < pixel_count; start += ${chunk}u) {
        floatv z[${chunk}], d[${chunk}];
% if frames:
        floatv t[${scenarios}][${chunk}];
        for (uint k = 0; k < scenario_count; k++)
            for (uint i = 0; i < ${chunk}u; i++) t[k][i] = 0.0f;
% else:
        floatv t[${chunk}];
% endif
% if pair:
        floatv reference[${chunk}];
% if frames:
        for (uint i = 0; i < ${chunk}u; i++) reference[i] = 0.0f;
        for (uint frame = 0; frame < frame_count; frame++) {
            const Address at = address(realisation, first_high, frame, seed_low, seed_high);
% endif
            draw_noise(&at, ${streams["reference_noise"]}u, start, ${chunk}u, z);
            draw_dark(&at, ${streams["reference_dark"]}u, start, ${chunk}u, pixels, tables, d);
            for (uint i = 0; i < ${chunk}u; i++)
% if frames:
                reference[i] += digitise(z[i], d[i], pixels[start + i].dark_gain, levels + start + i);
        }
        for (uint i = 0; i < ${chunk}u; i++) reference[i] += levels[start + i].offset;
% else:
                reference[i] = digitise(z[i], d[i], pixels[start + i].dark_gain, levels + start + i) + levels[start + i].offset;
% endif
% endif
% if frames:
        for (uint frame = 0; frame < frame_count; frame++) {
            const Address at = address(realisation, first_high, frame, seed_low, seed_high);
% endif
            draw_noise(&at, ${streams["noise"]}u, start, ${chunk}u, z);
            draw_dark(&at, ${streams["dark"]}u, start, ${chunk}u, pixels, tables, d);
% if frames:
            for (uint k = 0; k < scenario_count; k++)
                for (uint i = 0; i < ${chunk}u; i++)
                    t[k][i] += digitise(z[i], d[i], pixels[start + i].dark_gain, levels + k * pixel_count + start + i);
        }
% endif
        uint l = 0;
        for (uint k = 0; k < scenario_count; k++) {
            __global const Level *level = levels + k * pixel_count + start;
            __global const Pixel *pixel = pixels + start;
% if frames:
            floatv *x = t[k];
            for (uint i = 0; i < ${chunk}u; i++) x[i] += level[i].offset;
% else:
            floatv *x = t;
            for (uint i = 0; i < ${chunk}u; i++) x[i] = digitise(z[i], d[i], pixel[i].dark_gain, level + i) + level[i].offset;
% endif
            Four sum = chi2[k];
            for (uint i = 0; i < ${chunk}u; i += 4) {
% for j, part in enumerate("abcd"):
                sum.${part} = FMA(x[i + ${j}u] * x[i + ${j}u], (floatv)pixel[i + ${j}u].inverse_variance, sum.${part});
% endfor
            }
            chi2[k] = sum;
% if elements:
            floatv inside = element[k], outside = chi2_element[k];
            for (uint i = 0; i < ${chunk}u; i += 4) {
                if (!pixel[i].end_among_four) {
                    /* Most of the time: four at once, one addition to wait for. */
                    inside += FMA(x[i], (floatv)pixel[i].used, x[i + 1] * pixel[i + 1].used)
                            + FMA(x[i + 2], (floatv)pixel[i + 2].used, x[i + 3] * pixel[i + 3].used);
                    continue;
                }
                for (uint j = i; j < i + 4u; j++) {
                    inside = FMA(x[j], (floatv)pixel[j].used, inside);
                    if (pixel[j].element_end) {
                        outside = FMA(inside * inside, (floatv)pixel[j].inverse_element_variance, outside);
                        inside = 0.0f;
                    }
                }
            }
            element[k] = inside;
            chi2_element[k] = outside;
% endif
            for (; l < linear_end[k]; l++) {
                __global const float *weight = weights + l * pixel_count + start;
                Four total = linear[l];
                for (uint i = 0; i < ${chunk}u; i += 4) {
% for j, part in enumerate("abcd"):
                    total.${part} = FMA(x[i + ${j}u], (floatv)weight[i + ${j}u], total.${part});
% endfor
                }
                linear[l] = total;
            }
% if pair:
            floatv both = chi2_pair[k];
            for (uint i = 0; i < ${chunk}u; i++) {
                floatv difference = x[i] - reference[i];
                both = FMA(difference * difference, (floatv)(0.5f * pixel[i].inverse_variance), both);
            }
            chi2_pair[k] = both;
% endif
        }
    }

    /* One row per channel: three fixed ones a scenario, then the linear ones. */
    __global float *out = values + item * ${width}u;
    for (uint k = 0; k < scenario_count; k++) {
        STORE(SUM(chi2[k]), out + (3u * k) * stride);
        STORE(chi2_element[k], out + (3u * k + 1u) * stride);
% if pair:
        STORE(chi2_pair[k], out + (3u * k + 2u) * stride);
% endif
    }
    for (uint l = 0; l < linear_end[scenario_count - 1]; l++)
        STORE(SUM(linear[l]), out + (3u * scenario_count + l) * stride);
}
