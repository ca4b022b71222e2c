## Fast kernel for the most frequent statistics: chi2, chi2_element and linear ones of every scenario against its
## reference, from one pass over common draws. `comparison.cl.mako` computes the others.
<%
    plain = joint and not (modulations or frames or photons or additive)
    powers = (["c4"] if quartic else []) + ["c3", "c2", "c1", "c0"]

    def each(text):
        """Repeat each statement for all vectors of realisations; @ is the index of a vector."""
        return " ".join(one.replace("@", str(v)) + ";" for one in text.split(";")[:-1] for v in range(vectors))
%>\
## x = observed - reference in whole DN; the fractional DN of the reference is a constant of each sum.
/* Each work-item processes ${vectors} vectors of realisations, which share the reads of levels. */
__kernel ${attributes}
void statistics(SCENE, const uint first_low, const uint first_high,
                __global const float *restrict constants,
                __global const float *restrict weights, __global const uint *restrict linear_end,
                __global const uint *restrict pixels_end,
                const uint stride, __global float *restrict values)
{
    const uint item = get_global_id(0), padded = job->padded_count, scenario_count = job->scenario_count;
    const uint linear_count = linear_end[scenario_count - 1u];
    Exposure observation[${vectors}];
    Four chi2[${scenarios}][${vectors}], linear[${linears + 1}][${vectors}];
    floatv element[${scenarios}][${vectors}], chi2_element[${scenarios}][${vectors}];
    for (uint v = 0; v < ${vectors}u; v++) {
        const uintv realisation = (uintv)(first_low + (item * ${vectors}u + v) * ${width}u) + LANE_INDEX;
        observation[v] = observed(SCENE_PASSED, realisation, first_high);
        for (uint k = 0; k < scenario_count; k++) {
            chi2[k][v] = NOTHING;
            element[k][v] = chi2_element[k][v] = (floatv)0.0f;
        }
        for (uint l = 0; l <= linear_count; l++) linear[l][v] = NOTHING;
    }

    for (uint start = 0; start < padded; start += CHUNK) {
        __global const Pixel *pixel = pixels + start;
% if frames:
        intv counts[${vectors}][${scenarios}][${chunk}];
        for (uint v = 0; v < ${vectors}u; v++) expose(SCENE_PASSED, observation + v, start, 0u, scenario_count, counts[v], 0, 0u);
% else:
        Draws drawn[${vectors}];
        for (uint v = 0; v < ${vectors}u; v++) draw(SCENE_PASSED, &observation[v].only.at, 0u, start, drawn + v);
% endif
        uint l = 0;
        for (uint k = 0; k < scenario_count; k++) {
            const uint here = k * padded + start;
            __global const Level *level = levels + here;
            Four sum[${vectors}];
            floatv inside[${vectors}], outside[${vectors}];
            ${each("sum[@] = chi2[k][@]; inside[@] = element[k][@]; outside[@] = chi2_element[k][@];")}
% if linear:
            /* The first linear statistic of a scenario is summed in this pass; without one, a dummy is summed. */
            const uint own = l < pixels_end[k] ? l++ : linear_count;
            __global const float *own_weight = weights + own * padded + start;
            Four own_sum[${vectors}];
            floatv x[${vectors}][${chunk}], ended[${vectors}][${chunk}];
            uint end[${chunk}], count = 0;
            const bool again_needed = l < pixels_end[k];
            ${each("own_sum[@] = linear[own][@];")}
% endif
            for (uint i = 0; i < CHUNK; i += 4u) {
                /* Four pixels at once: constant address offsets and independent sums. */
                __global const Level *four = level + i;
                floatv y[${vectors}][4], term[${vectors}];
% for j, part in enumerate("abcd"):
% if plain:
                /* The polynomial of analogue(), with the vectors interleaved. */
                ${each(f"y[@][{j}] = (floatv)four[{j}].{powers[0]};")}
% for power in powers[1:]:
                ${each(f"y[@][{j}] = FMA(drawn[@].z[i + {j}u], y[@][{j}], (floatv)four[{j}].{power});")}
% endfor
                ${each(f"y[@][{j}] = digitise(y[@][{j}], edges + here + i + {j}u) - four[{j}].shift;")}
% elif frames:
                ${each(f"y[@][{j}] = TO_FLOAT(counts[@][k][i + {j}u]) + edges[here + i + {j}u].whole;")}
% else:
                ${each(f"y[@][{j}] = analogue(SCENE_PASSED, drawn + @, i + {j}u, four + {j}, start + i + {j}u, here + i + {j}u, &observation[@].only.factors); y[@][{j}] = digitise(y[@][{j}], edges + here + i + {j}u) - four[{j}].shift;")}
% endif
                ${each(f"term[@] = FMA(y[@][{j}], (floatv)four[{j}].inverse_variance, (floatv)four[{j}].twice); sum[@].{part} = FMA(y[@][{j}], term[@], sum[@].{part});")}
% if linear:
                ${each(f"own_sum[@].{part} = FMA(y[@][{j}], (floatv)own_weight[i + {j}u], own_sum[@].{part});")}
% endif
% endfor
% if linear:
                if (again_needed) {
% for j in range(4):
                    ${each(f"x[@][i + {j}u] = y[@][{j}];")}
% endfor
                }
% endif
% if elements:
                if (!pixel[i].four_uneven) {
                    /* The common case: one dependent addition. */
                    ${each("inside[@] += (y[@][0] + y[@][1]) + (y[@][2] + y[@][3]);")}
                } else {
% for j in range(4):
                    ${each(f"inside[@] = FMA(y[@][{j}], (floatv)pixel[i + {j}u].used, inside[@]);")}
                    if (pixel[i + ${j}u].element_end) {
                        __global const Edge *edge = edges + here + i + ${j}u;
                        ${each("inside[@] += edge->element_offset;")}
% if linear:
                        ${each(f"ended[@][count] = inside[@];")}
                        end[count++] = start + i + ${j}u;
% endif
                        ${each("outside[@] = FMA(inside[@] * inside[@], (floatv)edge->inverse_element_variance, outside[@]); inside[@] = (floatv)0.0f;")}
                    }
% endfor
                }
% endif
            }
            ${each("chi2[k][@] = sum[@]; element[k][@] = inside[@]; chi2_element[k][@] = outside[@];")}
% if linear:
            ${each("linear[own][@] = own_sum[@];")}
            for (; l < pixels_end[k]; l++) {
                __global const float *weight = weights + l * padded + start;
                Four total[${vectors}];
                ${each("total[@] = linear[l][@];")}
                for (uint i = 0; i < CHUNK; i += 4u) {
% for j, part in enumerate("abcd"):
                    ${each(f"total[@].{part} = FMA(x[@][i + {j}u], (floatv)weight[i + {j}u], total[@].{part});")}
% endfor
                }
                ${each("linear[l][@] = total[@];")}
            }
% if elements:
            for (; l < linear_end[k]; l++)
                for (uint n = 0; n < count; n++) {
                    const float weight = weights[l * padded + end[n]];
                    ${each("linear[l][@].a = FMA(ended[@][n], (floatv)weight, linear[l][@].a);")}
                }
% endif
% endif
        }
    }

    /* One row per channel: fixed statistics of each scenario, then linear ones. */
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
