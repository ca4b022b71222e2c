## Draws for flares added to existing frames: normals for the photon noise of the flare, and the factor on all light.
<%
    words = [("stare_frame", 0)] * jittered + [("stare_glow", group) for group in range(-(-sums // 4))]
    n_words = len(words)
%>\
__kernel ${attributes}
void stare_glow(__global const Job *restrict job, STARE, const uint first_low, const uint first_high, const uint frames_each,
                const uint row_count, __global float *restrict values)
{
    /* values[stare][statistic, then light minus one][frame] */
    const uint stare = get_global_id(0), stride = stare_job->padded_frames;
    const uint begin = get_global_id(1) * frames_each, end = least(begin + frames_each, stride);
    const uintv realisation = (uintv)(first_low + stare);
    floatv unknown[${4 * unknown_groups + 1}];
% if unknown_groups:
    unknowns_of(*stare_job, realisation, first_high, job->seed_low, job->seed_high, unknown);
% endif
    for (uint frame = begin; frame < end; frame += ${width}u) {
        const uintv number = LOAD(numbers + frame);
        floatv z[${4 * n_words}];
        uintv w[${4 * n_words}];
        Words x;
% for place, (stream, group) in enumerate(words):
        x = philox(realisation, (uintv)first_high, number, (uintv)${(streams[stream] << 24) + group}u, job->seed_low, job->seed_high);
        w[${4 * place}] = x.a; w[${4 * place + 1}] = x.b; w[${4 * place + 2}] = x.c; w[${4 * place + 3}] = x.d;
% endfor
        for (uint i = 0; i < ${4 * n_words}u; i += 2u) normal_pair(w + i, z + i);
        const Strengths strengths = strengths_of(STARE_PASSED, frame, z, unknown, LOST(stare));
        __global float *out = values + (size_t)stare * ${sums + 1}u * stride + frame;
% for a in range(sums):
        STORE(z[${4 * jittered + a}u], out + ${a}u * stride);
% endfor
        STORE(strengths.light, out + ${sums}u * stride);
    }
}
