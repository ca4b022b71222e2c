## Stares without pixels: weighted sums of each frame from their joint cumulants, which are linear in the strengths of a
## few spectra. The sums are transformed to be independent with unit variance at coefficients of one.
<%
    from itertools import combinations_with_replacement
    pairs = [(a, b) for a in range(sums) for b in range(a + 1)]
    threes = [(a, b, c) for a, b in pairs for c in range(b + 1)]
    fours = [(a, b, c, d) for a, b, c in threes for d in range(c + 1)] if fourths else []
    row = sums + len(pairs) + len(threes) + len(fours)
    at = {key: sums + i for i, key in enumerate(pairs + threes + fours)}
    lights = [("strengths.star", 1), ("strengths.sky", 2)] + [("strengths.neighbours", 4)] * neighbours
    lights += [(f"flare[{j}]", 5 + j) for j in range(spectra)]
    words = [("stare_frame", 0)] * jittered + [("stare_sums", group) for group in range(-(-sums // 4))]
    n_words = len(words)
    def name(*key):
        return "".join(str(i) for i in sorted(key, reverse=True))
    def chain(terms):
        """Return the sum of products, starting with the first."""
        (a, b), *rest = terms
        text = f"{a} * {b}"
        for a, b in rest:
            text = f"FMA({a}, {b}, {text})"
        return text
    def remaining(a, b):
        """Return a covariance minus the contribution of earlier columns of its factor."""
        text = f"c{a}{b}"
        for i in range(b):
            text = f"FMA(-l{a}{i}, l{b}{i}, {text})"
        return text
    def cumulant(offset, lit=True):
        """Return a cumulant at the given strengths."""
        text = f"(floatv)table[{offset}]"
        rows = [("strengths.dark", 3)] + (lights if lit else [])
        for strength, r in rows:
            text = f"FMA({strength}, (floatv)table[{r * row + offset}], {text})"
        return text
%>\
__kernel ${attributes}
void stare_sums(__global const Job *restrict job, STARE, const uint first_low, const uint first_high, const uint frames_each,
                __global const float *restrict table, const uint row_count, __global float *restrict values)
{
    /* values[scenario][stare][statistic][frame] */
    const uint stare = get_global_id(0), stride = stare_job->padded_frames, scenario_count = stare_job->scenario_count;
    const uint begin = get_global_id(1) * frames_each, end = least(begin + frames_each, stride);
    const uintv realisation = (uintv)(first_low + stare);
    floatv unknown[${4 * unknown_groups + 1}];
% if unknown_groups:
    unknowns_of(*stare_job, realisation, first_high, job->seed_low, job->seed_high, unknown);
% endif
    __global const float *whole = table + ${row * (5 + spectra)}u;
    for (uint frame = begin; frame < end; frame += ${width}u) {
        const uintv number = LOAD(numbers + frame);
        /* Normals for the jitters and the sums. */
        floatv z[${4 * n_words}];
        uintv w[${4 * n_words}];
        Words x;
% for place, (stream, group) in enumerate(words):
        x = philox(realisation, (uintv)first_high, number, (uintv)${(streams[stream] << 24) + group}u, job->seed_low, job->seed_high);
        w[${4 * place}] = x.a; w[${4 * place + 1}] = x.b; w[${4 * place + 2}] = x.c; w[${4 * place + 3}] = x.d;
% endfor
% if n_words % 2 == 0:
        for (uint i = 0; i < ${4 * n_words}u; i += 8u) four_normal_pairs(w + i, z + i);
% else:
        for (uint i = 0; i < ${4 * n_words}u; i += 2u) normal_pair(w + i, z + i);
% endif
        const Strengths strengths = strengths_of(STARE_PASSED, frame, z, unknown, LOST(stare));
        const floatv *y = z + ${4 * jittered}u;
        /* Quadratic terms of the skewness. */
% for a, b in pairs:
        const floatv q${a}${b} = ${f"FMA(y[{a}], y[{a}], (floatv)-1.0f) * 0.16666667f" if a == b else f"y[{a}] * y[{b}] * 0.33333334f"};
% endfor
        for (uint k = 0; k < scenario_count; k++) {
% if spectra:
            floatv flare[${spectra}];
            const floatv amplitude = OF_FRAME(known + 8u * stride) * amplitudes[k * stare_job->amplitude_rows + (stare_job->amplitude_rows > 1u ? stare : 0u)];
            __global const float *from = flares + (size_t)(stare_job->flare_rows > 1u ? stare : 0u) * ${spectra}u * stride;
            for (uint j = 0; j < ${spectra}u; j++) {
                flare[j] = OF_FRAME(from + j * stride) * amplitude;
                flare[j] = FMA(strengths.light, flare[j], flare[j]);
            }
% endif
            /* Covariances, their Cholesky factor l and its inverse m. */
% for a, b in pairs:
            const floatv c${a}${b} = ${cumulant(at[a, b])};
% endfor
% for b in range(sums):
            const floatv l${b}${b} = root(${remaining(b, b)}), m${b}${b} = 1.0f / l${b}${b};
% for a in range(b + 1, sums):
            const floatv l${a}${b} = ${remaining(a, b)} * m${b}${b};
% endfor
% endfor
% for a in range(sums):
% for b in range(a):
            const floatv m${a}${b} = -(${chain([(f"l{a}{i}", f"m{i}{b}") for i in range(b, a)])}) * m${a}${a};
% endfor
% endfor
            /* Third cumulants, transformed to the independent z one index at a time. */
% for key in threes:
            const floatv t${name(*key)} = ${cumulant(at[key], lit=counts)};
% endfor
% for a in range(sums):
% for b, c in pairs:
            const floatv a${a}_${b}${c} = ${chain([(f"m{a}{i}", f"t{name(i, b, c)}") for i in range(a + 1)])};
% endfor
% endfor
% for a, b in pairs:
% for c in range(sums):
            const floatv b${a}${b}_${c} = ${chain([(f"m{b}{i}", f"a{a}_{name(i, c)}") for i in range(b + 1)])};
% endfor
% endfor
% for a, b, c in threes:
            const floatv s${a}${b}${c} = ${chain([(f"m{c}{i}", f"b{a}{b}_{i}") for i in range(c + 1)])};
% endfor
% for a in range(sums):
            floatv x${a} = y[${a}];
% for b, c in pairs:
            x${a} = FMA(s${name(a, b, c)}, q${b}${c}, x${a});
% endfor
% if fourths:
            {
                floatv f = (floatv)0.0f;
% for key in combinations_with_replacement(range(a, -1, -1), 4):
                f = FMA(${" * ".join(f"m{a}{i}" for i in key)}, ${cumulant(at[key], lit=counts)}, f);
% endfor
                const floatv zz = y[${a}] * y[${a}];
                x${a} = FMA(f * y[${a}], FMA(zz, (floatv)0.041666668f, (floatv)-0.125f), x${a});
                x${a} = FMA(-s${name(a, a, a)} * s${name(a, a, a)} * y[${a}], FMA(zz, (floatv)0.055555556f, (floatv)-0.1388889f), x${a});
            }
% endif
% endfor
% for a in range(sums):
            const floatv u${a} = ${cumulant(a)} + (${chain([(f"l{a}{i}", f"x{i}") for i in range(a + 1)])});
% endfor
            __global float *out = values + ((size_t)k * row_count + stare) * ${sums}u * stride + frame;
% for a in range(sums):
            STORE(${chain([(f"(floatv)whole[{pairs.index((a, i))}]", f"u{i}") for i in range(a + 1)])}, out + ${a}u * stride);
% endfor
        }
    }
}
