/* Where the rings of a revolution are cut: `optshape_graph.detection.segments`, which is the reference. */

#include "vector_math.h"

#include <stdlib.h>

/* How far the jump to a return is from a straight line through two returns on one side of it, in standard deviations. */
static double off_line(double gap, double jump, double span, double rise, double steepest, double noise)
{
    double slope = least(most(rise / span, -steepest), steepest), q = gap / span;
    return fabs(jump - slope * gap) / (noise * sqrt(1.0 + (1.0 + q) * (1.0 + q) + q * q));
}

/* Whether a segment starts at each of n returns, by ring and azimuth: `_starts`. Returns 1 where there is no memory. */
int64_t segment_starts(int64_t n, const int64_t *ring, const double *azimuth, const double *range, double step,
                       double longest_gap, double steepest, double noise, double jump_sigmas, uint8_t *starts)
{
    int32_t *run = malloc((size_t)(n + 1) * sizeof(int32_t));
    if (!run)
        return 1;
    for (int64_t i = 0; i < n; i++) {
        int apart = i == 0 || ring[i] != ring[i - 1] || azimuth[i] - azimuth[i - 1] > longest_gap * step;
        starts[i] = (uint8_t)apart;
        run[i] = (i ? run[i - 1] : 0) + apart;
    }
    for (int64_t i = 1; i < n; i++) {
        if (starts[i])
            continue;
        double gap = azimuth[i] - azimuth[i - 1], jump = range[i] - range[i - 1], off = INFINITY;
        if (i >= 3 && run[i - 3] == run[i - 1]) {
            double span = fabs(azimuth[i - 1] - azimuth[i - 3]);
            if (span > 0.5 * step)
                off = off_line(gap, jump, span, range[i - 1] - range[i - 3], steepest * range[i], noise);
        }
        if (off > jump_sigmas && i + 2 < n && run[i + 2] == run[i]) {
            double span = fabs(azimuth[i] - azimuth[i + 2]);
            if (span > 0.5 * step)
                off = least(off, off_line(gap, jump, span, range[i + 2] - range[i], steepest * range[i], noise));
        }
        if (off == INFINITY)
            off = fabs(jump) / (sqrt(2.0) * noise);
        starts[i] = off > jump_sigmas;
    }
    free(run);
    return 0;
}
