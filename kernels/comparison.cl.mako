## General statistics of every scenario: noisy reference exposures, variances estimated from counts, smoothed spectra.
## Statistics that `statistics.cl.mako` computes too have the same bits here.
<%
    single = pair or slots
    exposures = "job->reference_count" if noisy else "1u"
%>\
% if estimated:
/* Variance that an observer estimates from a count: photon noise of the count, known dark and read noise. */
INLINE floatv variance_of(floatv x, __global const Estimate *e)
{
    return FMA(most(x + e->net_offset, (floatv)0.0f), (floatv)e->gain, (floatv)e->variance);
}
% endif

__kernel ${attributes}
void comparison(SCENE, const uint first_low, const uint first_high,
                __global const uint *restrict references, __global const float *restrict constants,
                __global const float *restrict weights, __global const uint *restrict linear_end,
                __global const uint *restrict pixels_end,
                __global const Estimate *restrict estimates, __global const float *restrict bands,
                __global const uint *restrict finished, __global const float *restrict scales,
                __global const uint *restrict scale_end, const uint smoothed_count,
                const uint stride, __global float *restrict values)
{
    const uint item = get_global_id(0), padded = job->padded_count, scenario_count = job->scenario_count;
    const uint linear_count = linear_end[scenario_count - 1u], scale_count = scale_end[scenario_count - 1u];
    const uintv realisation = (uintv)(first_low + item * ${width}u) + LANE_INDEX;
    const Exposure observation = observed(SCENE_PASSED, realisation, first_high);
    Four chi2[${scenarios}], linear[${linears + 1}];
    floatv element[${scenarios}], chi2_element[${scenarios}], chi2_pair[${scenarios}];
% if estimated:
    Four linear_variance[${linears + 1}];
    floatv element_variance[${scenarios}];
% endif
% if slots:
    /* Partial sums of smoothed values; slot 0 is completed first. */
    floatv window[${scenarios}][${slots}], smoothed[${smooths}];
    uint centre = 0;
    for (uint r = 0; r < scale_count; r++) smoothed[r] = (floatv)0.0f;
% endif
    for (uint k = 0; k < scenario_count; k++) {
        chi2[k] = NOTHING;
        element[k] = chi2_element[k] = chi2_pair[k] = (floatv)0.0f;
% if estimated:
        element_variance[k] = (floatv)0.0f;
% endif
% if slots:
        for (uint s = 0; s < ${slots}u; s++) window[k][s] = (floatv)0.0f;
% endif
    }
    for (uint l = 0; l < linear_count; l++) {
        linear[l] = NOTHING;
% if estimated:
        linear_variance[l] = NOTHING;
% endif
    }

    for (uint start = 0; start < padded; start += CHUNK) {
        __global const Pixel *pixel = pixels + start;
        intv counts[${scenarios}][${chunk}];
        expose(SCENE_PASSED, &observation, start, 0u, scenario_count, counts, 0, 0u);
% if noisy or single:
        /* First quiescent exposure and sum of all, which scenarios with the same reference share. */
        floatv first[${chunk}], sum[${chunk}];
        uint seen = ~0u;
% endif
        uint l = 0, r = 0;
% if slots:
        uint reached = centre;
% endif
        for (uint k = 0; k < scenario_count; k++) {
            __global const Level *level = levels + k * padded + start;
            __global const Edge *edge = edges + k * padded + start;
% if noisy or single:
            if (references[k] != seen) {
                seen = references[k];
                for (uint i = 0; i < CHUNK; i++) sum[i] = (floatv)0.0f;
                for (uint number = 0; number < ${exposures}; number++) {
                    const Exposure other = another(SCENE_PASSED, observation, REFERENCE, number);
                    intv quiet[1][${chunk}];
                    expose(SCENE_PASSED, &other, start, seen, seen + 1u, quiet, 0, 0u);
                    for (uint i = 0; i < CHUNK; i++) sum[i] += TO_FLOAT(quiet[0][i]) + (floatv)edges[seen * padded + start + i].whole;
                    if (number == 0u)
                        for (uint i = 0; i < CHUNK; i++) first[i] = sum[i];
                }
            }
% endif
            floatv t[${chunk}];
            for (uint i = 0; i < CHUNK; i++) t[i] = TO_FLOAT(counts[k][i]) + (floatv)edge[i].whole;
            floatv x[${chunk}];
% if estimated:
            __global const Estimate *estimate = estimates + k * padded + start;
            floatv variance[${chunk}];
% endif
% if single:
            floatv apart[${chunk}];
            for (uint i = 0; i < CHUNK; i++) apart[i] = t[i] - first[i];
% endif
% if pair:
            for (uint i = 0; i < CHUNK; i++) {
% if estimated:
                const floatv both = variance_of(t[i], estimate + i) + variance_of(first[i], estimate + i);
                chi2_pair[k] = FMA(apart[i] * apart[i], (floatv)pixel[i].used / both, chi2_pair[k]);
% else:
                chi2_pair[k] = FMA(apart[i] * apart[i], (floatv)(job->pair_scale * level[i].inverse_variance), chi2_pair[k]);
% endif
            }
% endif
            for (uint i = 0; i < CHUNK; i++) {
                x[i] = ${"FMA(sum[i], (floatv)-job->reference_weight, t[i])" if noisy else "t[i]"};
% if estimated:
                variance[i] = variance_of(t[i], estimate + i);
% if noisy:
                variance[i] += job->reference_weight * variance_of(sum[i] * job->reference_weight, estimate + i);
% endif
                x[i] += estimate[i].fraction;
% endif
            }
            for (uint i = 0; i < CHUNK; i += 4u) {
% for j, part in enumerate("abcd"):
% if estimated:
                chi2[k].${part} = FMA(x[i + ${j}u] * x[i + ${j}u], (floatv)pixel[i + ${j}u].used / variance[i + ${j}u], chi2[k].${part});
% else:
                chi2[k].${part} = FMA(x[i + ${j}u], FMA(x[i + ${j}u], (floatv)level[i + ${j}u].inverse_variance, (floatv)level[i + ${j}u].twice), chi2[k].${part});
% endif
% endfor
            }
% if elements:
            for (uint i = 0; i < CHUNK; i += 4u) {
% if not estimated:
                if (!pixel[i].four_uneven) {
                    element[k] += (x[i] + x[i + 1u]) + (x[i + 2u] + x[i + 3u]);
                    continue;
                }
% endif
                for (uint j = i; j < i + 4u; j++) {
                    element[k] = FMA(x[j], (floatv)pixel[j].used, element[k]);
% if estimated:
                    element_variance[k] = FMA(variance[j], (floatv)pixel[j].used, element_variance[k]);
% endif
                    if (pixel[j].element_end) {
% if estimated:
                        /* An element without used pixels adds 0 / 1e-12. */
                        chi2_element[k] += element[k] * element[k] / most(element_variance[k], (floatv)1e-12f);
                        element_variance[k] = (floatv)0.0f;
% else:
                        element[k] += edge[j].element_offset;
% if linear:
                        for (uint q = pixels_end[k]; q < linear_end[k]; q++)
                            linear[q].a = FMA(element[k], (floatv)weights[q * padded + start + j], linear[q].a);
% endif
                        chi2_element[k] = FMA(element[k] * element[k], (floatv)edge[j].inverse_element_variance, chi2_element[k]);
% endif
                        element[k] = (floatv)0.0f;
                    }
                }
            }
% endif
            for (; l < pixels_end[k]; l++) {
                __global const float *weight = weights + l * padded + start;
                for (uint i = 0; i < CHUNK; i += 4u) {
% for j, part in enumerate("abcd"):
                    linear[l].${part} = FMA(x[i + ${j}u], (floatv)weight[i + ${j}u], linear[l].${part});
% if estimated:
                    linear_variance[l].${part} = FMA((floatv)(weight[i + ${j}u] * weight[i + ${j}u]), variance[i + ${j}u], linear_variance[l].${part});
% endif
% endfor
                }
            }
            l = linear_end[k];
% if slots:
            __global const float *band = bands + (size_t)(start / CHUNK) * ${slots}u * CHUNK;
            for (uint s = 0; s < ${slots}u; s += 4u) {
                /* Four independent sums at a time, to hide latency. */
                floatv a = window[k][s], b = window[k][s + 1u], c = window[k][s + 2u], d = window[k][s + 3u];
                for (uint i = 0; i < CHUNK; i++) {
% for j, part in enumerate("abcd"):
                    ${part} = FMA(apart[i], (floatv)band[(s + ${j}u) * CHUNK + i], ${part});
% endfor
                }
                window[k][s] = a; window[k][s + 1u] = b; window[k][s + 2u] = c; window[k][s + 3u] = d;
            }
            reached = centre;
            for (uint n = 0; n < finished[start / CHUNK]; n++, reached++) {
                const floatv square = window[k][0] * window[k][0];
                for (uint q = r; q < scale_end[k]; q++) smoothed[q] = FMA(square, (floatv)scales[q * smoothed_count + reached], smoothed[q]);
                for (uint s = 1u; s < ${slots}u; s++) window[k][s - 1u] = window[k][s];
                window[k][${slots - 1}] = (floatv)0.0f;
            }
            r = scale_end[k];
% endif
        }
% if slots:
        centre = reached;
% endif
    }

    /* One row per channel: fixed statistics of each scenario, then linear, then smoothed ones. */
    __global float *out = values + item * ${width}u;
    for (uint k = 0; k < scenario_count; k++) {
        STORE(SUM(chi2[k]) + constants[k], out + ${fixed}u * k * stride);
        STORE(chi2_element[k], out + (${fixed}u * k + 1u) * stride);
        STORE(chi2_pair[k], out + (${fixed}u * k + 2u) * stride);
    }
    out += ${fixed}u * scenario_count * stride;
    for (uint l = 0; l < linear_count; l++) {
% if estimated:
        STORE(SUM(linear[l]) / root(SUM(linear_variance[l])), out + l * stride);
% else:
        STORE(SUM(linear[l]) + constants[scenario_count + l], out + l * stride);
% endif
    }
% if slots:
    out += linear_count * stride;
    for (uint q = 0; q < scale_count; q++) STORE(smoothed[q], out + q * stride);
% endif
}
