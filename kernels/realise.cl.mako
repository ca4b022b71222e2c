## Raw spectra: rows of whole DN, one realisation each, summed over the frames.
% if vector_forms:
#define CONVERT_ROW(x) __builtin_convertvector((x), ${row_type}${width})
% else:
#define CONVERT_ROW(x) convert_${row_type}${"" if width == 1 else width}(x)
% endif
__kernel ${attributes}
void realise(SCENE, const uint first_low, const uint first_high, const uint start_row, const uint stop_row,
             __global uint *restrict clipped, __global ${row_type} *restrict rows)
{
    /* rows[realisation][pixel], clipped[realisation]; only rows start_row to stop_row - 1 of the launch are kept. */
    const uint item = get_global_id(0), pixel_count = job->pixel_count;
    const uintv realisation = (uintv)(first_low + item * ${width}u) + LANE_INDEX;
    const Exposure observation = observed(SCENE_PASSED, realisation, first_high);
    uintv met[1][2] = {{(uintv)0u, (uintv)0u}};
    for (uint start = 0; start < pixel_count; start += CHUNK) {
        intv dn[1][${chunk}];
        expose(SCENE_PASSED, &observation, start, 0u, 1u, dn, met, 0u);
        /* Transpose from pixels of WIDTH realisations to realisations of CHUNK pixels. */
        const uint end = pixel_count - start < CHUNK ? pixel_count - start : CHUNK;
        ${row_type} block[${chunk}][${width}];
        for (uint i = 0; i < CHUNK; i++) STORE(CONVERT_ROW(dn[0][i] + (intv)(int)job->draw_count * (intv)edges[start + i].base), block[i]);
        for (uint lane = 0; lane < ${width}u; lane++) {
            const uint row = item * ${width}u + lane;
            if (row < start_row || row >= stop_row) continue;
            __global ${row_type} *out = rows + (size_t)(row - start_row) * pixel_count + start;
            if (end == CHUNK) {
                for (uint i = 0; i < CHUNK; i++) out[i] = block[i][lane];
            } else {
                for (uint i = 0; i < end; i++) out[i] = block[i][lane];
            }
        }
    }
    uint met_lanes[${width}];
    STORE(met[0][0] + met[0][1], met_lanes);
    for (uint lane = 0; lane < ${width}u; lane++) {
        const uint row = item * ${width}u + lane;
        if (row >= start_row && row < stop_row) clipped[row - start_row] = met_lanes[lane];
    }
}
