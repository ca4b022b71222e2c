## chi2, chi2_element and linear statistics of every scenario against its template, from one pass over common draws:
## the fast kernel, for what is asked most. `comparison.cl.mako` knows the rest.
<%
    plain = joint and not (modulations or frames or photons or cosmic)
    powers = (["c4"] if quartic else []) + ["c3", "c2", "c1", "c0"]
%>\
## x = observed - template, whole DN: what is left of the template's fraction of a DN is a constant of each sum.
/* Four sums side by side, by pixel number modulo four: one alone would wait for each addition to end. */
typedef struct { floatv a, b, c, d; } Four;
#define NOTHING (Four){(floatv)0.0f, (floatv)0.0f, (floatv)0.0f, (floatv)0.0f}
#define SUM(x) (((x).a + (x).b) + ((x).c + (x).d))

/* Each work-item follows ${vectors} vectors of realisations: what is read of a level serves them all. */
__kernel ${attributes}
void statistics(SCENE, const uint first_low, const uint first_high,
                __global const float *restrict constants,
                __global const float *restrict weights, __global const uint *restrict linear_end,
                const uint stride, __global float *restrict values)
{
    const uint item = get_global_id(0), padded = job->padded_count, scenario_count = job->scenario_count;
    const uint linear_count = linear_end[scenario_count - 1u];
    uintv realisation[${vectors}];
    Factors steady[${vectors}];
    Four chi2[${scenarios}][${vectors}], linear[${linears + 1}][${vectors}];
    floatv element[${scenarios}][${vectors}], chi2_element[${scenarios}][${vectors}];
    for (uint v = 0; v < ${vectors}u; v++) {
        realisation[v] = (uintv)(first_low + (item * ${vectors}u + v) * ${width}u) + LANE_INDEX;
        steady[v] = factors_of(SCENE_PASSED, realisation[v], first_high);
        for (uint k = 0; k < scenario_count; k++) {
            chi2[k][v] = NOTHING;
            element[k][v] = chi2_element[k][v] = (floatv)0.0f;
        }
        for (uint l = 0; l <= linear_count; l++) linear[l][v] = NOTHING;
    }
% if not frames:
    Address at[${vectors}];
    Factors factors[${vectors}];
    for (uint v = 0; v < ${vectors}u; v++) {
        at[v] = address(realisation[v], first_high, job->first_frame, job->seed_low, job->seed_high);
        factors[v] = steady[v];
        factors[v].light = TOGETHER(factors[v].light, kept(SCENE_PASSED, realisation[v], first_high, 0u, 0u));
    }
% endif

    for (uint start = 0; start < padded; start += CHUNK) {
        __global const Pixel *pixel = pixels + start;
        Draws drawn[${vectors}];
% if frames:
        floatv t[${scenarios}][${vectors}][${chunk}];
        for (uint v = 0; v < ${vectors}u; v++) {
            for (uint k = 0; k < scenario_count; k++)
                for (uint i = 0; i < CHUNK; i++) t[k][v][i] = (floatv)0.0f;
            for (uint frame = 0; frame < job->draw_count; frame++) {
                const Address at = address(realisation[v], first_high, job->first_frame + frame, job->seed_low, job->seed_high);
                Factors factors = steady[v];
                factors.light = TOGETHER(factors.light, kept(SCENE_PASSED, realisation[v], first_high, 0u, frame));
                draw(SCENE_PASSED, &at, 0u, start, drawn);
                for (uint k = 0; k < scenario_count; k++)
                    for (uint i = 0; i < CHUNK; i++) {
                        const uint here = k * padded + start + i;
                        t[k][v][i] += digitise(analogue(SCENE_PASSED, drawn, i, levels + here, start + i, here, &factors), edges + here) - MAGIC;
                    }
            }
        }
% else:
        for (uint v = 0; v < ${vectors}u; v++) draw(SCENE_PASSED, at + v, 0u, start, drawn + v);
% endif
        uint l = 0;
        for (uint k = 0; k < scenario_count; k++) {
            const uint here = k * padded + start;
            __global const Level *level = levels + here;
            Four sum[${vectors}];
            floatv inside[${vectors}], outside[${vectors}];
% for v in range(vectors):
            sum[${v}] = chi2[k][${v}];
            inside[${v}] = element[k][${v}];
            outside[${v}] = chi2_element[k][${v}];
% endfor
% if linear:
            /* The scenario's first linear statistic is summed on the way; one without any adds nothing to the last. */
            const uint own = l < linear_end[k] ? l++ : linear_count;
            __global const float *own_weight = weights + own * padded + start;
            Four own_sum[${vectors}];
% for v in range(vectors):
            own_sum[${v}] = linear[own][${v}];
% endfor
% endif
% if linear:
            floatv x[${vectors}][${chunk}];
            const bool again_needed = l < linear_end[k];
% endif
            for (uint i = 0; i < CHUNK; i += 4u) {
                /* Four pixels at once: addresses without an index, and sums that need not wait for each other. */
                __global const Level *four = level + i;
                floatv y[${vectors}][4], term[${vectors}];
% for j, part in enumerate("abcd"):
% if plain:
                /* As analogue() and digitise() have it, steps of the vectors in turn. */
% for v in range(vectors):
                y[${v}][${j}] = (floatv)four[${j}].${powers[0]};
% endfor
% for power in powers[1:]:
% for v in range(vectors):
                y[${v}][${j}] = FMA(drawn[${v}].z[i + ${j}u], y[${v}][${j}], (floatv)four[${j}].${power});
% endfor
% endfor
% for v in range(vectors):
                y[${v}][${j}] = digitise(y[${v}][${j}], edges + here + i + ${j}u) - four[${j}].shift;
% endfor
% else:
% for v in range(vectors):
% if frames:
                y[${v}][${j}] = t[k][${v}][i + ${j}u] + edges[here + i + ${j}u].whole;
% else:
                y[${v}][${j}] = digitise(analogue(SCENE_PASSED, drawn + ${v}, i + ${j}u, four + ${j}, start + i + ${j}u, here + i + ${j}u, factors + ${v}), edges + here + i + ${j}u) - four[${j}].shift;
% endif
% endfor
% endif
% for v in range(vectors):
                term[${v}] = FMA(y[${v}][${j}], (floatv)four[${j}].inverse_variance, (floatv)four[${j}].twice);
% endfor
% for v in range(vectors):
                sum[${v}].${part} = FMA(y[${v}][${j}], term[${v}], sum[${v}].${part});
% endfor
% if linear:
% for v in range(vectors):
                own_sum[${v}].${part} = FMA(y[${v}][${j}], (floatv)own_weight[i + ${j}u], own_sum[${v}].${part});
% endfor
% endif
% endfor
% if linear:
                if (again_needed) {
% for j in range(4):
% for v in range(vectors):
                    x[${v}][i + ${j}u] = y[${v}][${j}];
% endfor
% endfor
                }
% endif
% if elements:
                if (!pixel[i].four_uneven) {
                    /* Most of the time: one addition to wait for. */
% for v in range(vectors):
                    inside[${v}] += (y[${v}][0] + y[${v}][1]) + (y[${v}][2] + y[${v}][3]);
% endfor
                } else {
                    for (uint j = 0; j < 4u; j++) {
% for v in range(vectors):
                        inside[${v}] = FMA(y[${v}][j], (floatv)pixel[i + j].used, inside[${v}]);
% endfor
                        if (pixel[i + j].element_end) {
% for v in range(vectors):
                            inside[${v}] += edges[here + i + j].element_offset;
                            outside[${v}] = FMA(inside[${v}] * inside[${v}], (floatv)edges[here + i + j].inverse_element_variance, outside[${v}]);
                            inside[${v}] = (floatv)0.0f;
% endfor
                        }
                    }
                }
% endif
            }
% for v in range(vectors):
            chi2[k][${v}] = sum[${v}];
            element[k][${v}] = inside[${v}];
            chi2_element[k][${v}] = outside[${v}];
% endfor
% if linear:
% for v in range(vectors):
            linear[own][${v}] = own_sum[${v}];
% endfor
            for (; l < linear_end[k]; l++) {
                __global const float *weight = weights + l * padded + start;
                Four total[${vectors}];
% for v in range(vectors):
                total[${v}] = linear[l][${v}];
% endfor
                for (uint i = 0; i < CHUNK; i += 4u) {
% for j, part in enumerate("abcd"):
% for v in range(vectors):
                    total[${v}].${part} = FMA(x[${v}][i + ${j}u], (floatv)weight[i + ${j}u], total[${v}].${part});
% endfor
% endfor
                }
% for v in range(vectors):
                linear[l][${v}] = total[${v}];
% endfor
            }
% endif
        }
    }

    /* One row per channel: the fixed ones of each scenario, then the linear ones. */
    for (uint v = 0; v < ${vectors}u; v++) {
        __global float *out = values + (item * ${vectors}u + v) * ${width}u;
        for (uint k = 0; k < scenario_count; k++) {
            STORE(SUM(chi2[k][v]) + constants[k], out + ${fixed}u * k * stride);
            STORE(chi2_element[k][v], out + (${fixed}u * k + 1u) * stride);
            STORE((floatv)0.0f, out + (${fixed}u * k + 2u) * stride);
        }
        for (uint l = 0; l < linear_count; l++)
            STORE(SUM(linear[l][v]) + constants[scenario_count + l], out + (${fixed}u * scenario_count + l) * stride);
    }
}
