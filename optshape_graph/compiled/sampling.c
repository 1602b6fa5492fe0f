/* Densities of many poses at once: `optshape_graph.pose.sampling`, which is the reference. */

#include "chords.h"

#include <stdlib.h>

enum { PLACES = 24, WINDOW = 4, PHASES = 4, MOST_FIRINGS = 12, BLOCK = 128 };

/* Some samples of one component. */
INLINE void log_block(int64_t n, int64_t samples, int64_t equivalents, const double *left, const double *base,
                      const double *whitening, const double *mean, double constant, const double *quaternions,
                      const double *places, const double *scalars, double freedom, double *log_density, double *chart)
{
    double q[4][BLOCK], largest[BLOCK], squared[BLOCK], white[BLOCK];
    for (int64_t s = 0; s < n; s++) {
        largest[s] = -1.0;
        squared[s] = 0.0;
    }
    for (int64_t k = 0; k < equivalents; k++) { /* the equivalent that is turned least */
        const double *p = quaternions + 4 * samples * k;
#pragma omp simd
        for (int64_t s = 0; s < n; s++) {
            double a = p[s], b = p[samples + s], d = p[2 * samples + s], e = p[3 * samples + s];
            double w = left[0] * a + left[1] * b + left[2] * d + left[3] * e;
            double x = left[4] * a + left[5] * b + left[6] * d + left[7] * e;
            double y = left[8] * a + left[9] * b + left[10] * d + left[11] * e;
            double z = left[12] * a + left[13] * b + left[14] * d + left[15] * e;
            int nearer = fabs(w) > largest[s];
            largest[s] = nearer ? fabs(w) : largest[s];
            q[0][s] = nearer ? w : q[0][s];
            q[1][s] = nearer ? x : q[1][s];
            q[2][s] = nearer ? y : q[2][s];
            q[3][s] = nearer ? z : q[3][s];
        }
    }
#pragma omp simd
    for (int64_t s = 0; s < n; s++) {
        double sine = sqrt(q[1][s] * q[1][s] + q[2][s] * q[2][s] + q[3][s] * q[3][s]);
        double turn = 2.0 * fast_angle(sine, largest[s]) / most(sine, 1e-150), per_sine = sine > 1e-150 ? turn : 2.0;
        double along = q[0][s] < 0 ? -per_sine : per_sine, x = places[s], y = places[samples + s], z = places[2 * samples + s];
        chart[s] = q[1][s] * along;
        chart[samples + s] = q[2][s] * along;
        chart[2 * samples + s] = q[3][s] * along;
        chart[3 * samples + s] = base[0] * x + base[1] * y + base[2] * z + base[3];
        chart[4 * samples + s] = base[4] * x + base[5] * y + base[6] * z + base[7];
        chart[5 * samples + s] = base[8] * x + base[9] * y + base[10] * z + base[11];
        chart[6 * samples + s] = scalars[s];
        /* How much volume of rotations a volume of rotation vectors covers there: (2 sin(x / 2) / x)^2. */
        log_density[s] = constant + 2.0 * fast_log(0.5 * per_sine);
    }
    for (int i = 0; i < 7; i++) {
        double off = 0.0;
        for (int j = 0; j <= i; j++)
            off -= whitening[7 * i + j] * mean[j];
        for (int64_t s = 0; s < n; s++)
            white[s] = off;
        for (int j = 0; j <= i; j++) {
            const double w = whitening[7 * i + j];
#pragma omp simd
            for (int64_t s = 0; s < n; s++)
                white[s] += w * chart[j * samples + s];
        }
#pragma omp simd
        for (int64_t s = 0; s < n; s++)
            squared[s] += white[s] * white[s];
    }
#pragma omp simd
    for (int64_t s = 0; s < n; s++)
        log_density[s] -= 0.5 * (freedom + 7.0) * fast_log(1.0 + squared[s] / freedom);
}

/* `mixture._log_components` for C components and S samples.

   Each component has a left matrix of quaternions (4, 4), a base (3, 4), the inverse root of its covariance (7, 7), a
   mean (7) and a constant; samples come by number: quaternions (K, 4, S), places (3, S), scalars (S). Out go logarithms
   (C, S), and where each component has each sample, (C, 7, S). */
FOR_EVERY_PROCESSOR
int64_t log_components(int64_t components, int64_t samples, int64_t equivalents, const double *left, const double *base,
                       const double *whitening, const double *mean, const double *constant, const double *quaternions,
                       const double *places, const double *scalars, double freedom, double *log_density, double *charts)
{
    for (int64_t c = 0; c < components; c++) {
        for (int64_t first = 0; first < samples; first += BLOCK) {
            int64_t n = samples - first < BLOCK ? samples - first : BLOCK;
            double *chart = charts + 7 * samples * c + first, *log_here = log_density + samples * c + first;
            log_block(n, samples, equivalents, left + 16 * c, base + 12 * c, whitening + 49 * c, mean + 7 * c, constant[c],
                      quaternions + first, places + first, scalars + first, freedom, log_here, chart);
        }
    }
    return 0;
}

/* `Firings`: R rings that returned, and O that did not and may be met; W whole steps that a ring may be off. */
typedef struct {
    int64_t rings, empty_rings, edges, whole, grid; /* grid: 0 each ring's own, 1 common, 2 common and seen */
    const double *left, *right, *shift, *sines, *cosines, *empty_sines, *empty_cosines, *empty_offset;
    const double *off, *density; /* (R, W, PLACES) how far left the last firing is, and its density */
    double low, high, lost_ends, lost_ring, step, reference_azimuth, seen_place;
} Firings;

/* Probability that a standard normal variable is between bounds, by the tail that keeps all digits. */
INLINE double mass_between(double low, double high)
{
    double a = low > 0 ? -low : high, b = low > 0 ? -high : low; /* of ndtr(a) - ndtr(b) */
    double ta = fabs(a) * SQRT_HALF, tb = fabs(b) * SQRT_HALF;
    double tail_a = 0.5 * fast_exp(-ta * ta) * scaled_tail(ta), tail_b = 0.5 * fast_exp(-tb * tb) * scaled_tail(tb);
    return (a < 0 ? tail_a : 1.0 - tail_a) - (b < 0 ? tail_b : 1.0 - tail_b);
}

/* The logarithm, where a number may be 0. */
INLINE double log_or_least(double x) { return fast_log(most(x, 1e-300)); }

/* `Firings.log_likelihood` of S polygons (n, 3). */
FOR_EVERY_PROCESSOR
int64_t firings_log_likelihood(const Firings *f, int64_t samples, const double *corners, double *out)
{
    int64_t n = f->edges, R = f->rings, O = f->empty_rings, W = f->whole, room = R > 1 ? R : 1;
    double *memory = malloc((size_t)(6 * n + 4 * room + 2 * (O + 1)) * sizeof(double));
    if (!memory)
        return 1;
    double *normals = memory, *arc = normals + 3 * n, *beyond_left = arc + 3 * n, *beyond_right = beyond_left + room;
    double *total = beyond_right + room, *empty_right = total + 2 * room, *empty_left = empty_right + O + 1;
    double floor_density = 0.1 * f->lost_ends * (0.1 * f->lost_ends), share = f->lost_ends, kept = 1.0 - share;
    double of_lost = share / (f->high - f->low), lost = f->lost_ring;
    const double low[2] = {0.0, f->low}, high[2] = {1.0, f->high}, density[2] = {kept, of_lost};
    for (int64_t s = 0; s < samples; s++) {
        double right, left;
        sight_planes(n, corners + 3 * n * s, normals);
        arcs(n, normals, f->reference_azimuth, arc);
        for (int64_t r = 0; r < R; r++) {
            chord(n, arc, f->sines[r], f->cosines[r], 0.0, &right, &left);
            beyond_left[r] = most(left, -4.0) / f->step - f->left[r];
            beyond_right[r] = f->right[r] - least(right, 4.0) / f->step;
            total[r] = 0.0;
        }
        for (int64_t o = 0; o < O; o++) {
            chord(n, arc, f->empty_sines[o], f->empty_cosines[o], 0.0, &right, &left);
            empty_right[o] = least(right, 4.0) / f->step;
            empty_left[o] = most(left, -4.0) / f->step;
        }
        /* Each ring on a grid of its own. */
        for (int a = 0; a < 2; a++)
            for (int b = 0; b < 2; b++) {
#pragma omp simd
                for (int64_t r = 0; r < R; r++) {
                    double first = most(beyond_left[r] - high[a], low[b] - beyond_right[r]) / f->shift[r];
                    double last = least(beyond_left[r] - low[a], high[b] - beyond_right[r]) / f->shift[r];
                    double mass = mass_between(first, most(last, first));
                    total[r] += last > first ? density[a] * density[b] * mass : 0.0;
                }
            }
        double rings = 0.0, missed = 0.0;
        for (int64_t r = 0; r < R; r++)
            rings += log_or_least(total[r] + floor_density);
        if (f->grid == 2) {
            for (int64_t o = 0; o < O; o++) {
                double place = f->seen_place + f->empty_offset[o];
                double unseen = floor(empty_left[o] - place) >= ceil(empty_right[o] - place) ? 0.0 : 1.0;
                missed += log_or_least(unseen * (1.0 - lost) + lost);
            }
            out[s] = rings + missed;
            continue;
        }
        for (int64_t o = 0; o < O; o++) {
            double unseen = least(most(1.0 - (empty_left[o] - empty_right[o]), 0.0), 1.0);
            missed += log_or_least(unseen * (1.0 - lost) + lost);
        }
        out[s] = rings + missed;
        if (f->grid == 0)
            continue;
        /* All on one grid, averaged over its place. */
        double log_at[PLACES] = {0}, sum[PLACES], top = -INFINITY, mean = 0.0;
        for (int64_t r = 0; r < R; r++) {
            for (int p = 0; p < PLACES; p++)
                sum[p] = floor_density;
            for (int64_t w = 0; w < W; w++) {
                const double *off = f->off + (r * W + w) * PLACES, *here = f->density + (r * W + w) * PLACES;
#pragma omp simd
                for (int p = 0; p < PLACES; p++) {
                    double l = beyond_left[r] - off[p], g = beyond_right[r] + off[p];
                    double at_left = (l >= 0.0 && l < 1.0 ? kept : 0.0) + (l >= f->low && l < f->high ? of_lost : 0.0);
                    double at_right = (g >= 0.0 && g < 1.0 ? kept : 0.0) + (g >= f->low && g < f->high ? of_lost : 0.0);
                    sum[p] += at_left * at_right * here[p];
                }
            }
#pragma omp simd
            for (int p = 0; p < PLACES; p++)
                log_at[p] += log_or_least(sum[p]);
        }
        for (int64_t o = 0; o < O; o++) {
#pragma omp simd
            for (int p = 0; p < PLACES; p++) {
                double place = (p + 0.5) / PLACES + f->empty_offset[o];
                double unseen = floor(empty_left[o] - place) >= ceil(empty_right[o] - place) ? 0.0 : 1.0;
                log_at[p] += log_or_least(unseen * (1.0 - lost) + lost);
            }
        }
        for (int p = 0; p < PLACES; p++)
            top = most(top, log_at[p]);
        for (int p = 0; p < PLACES; p++)
            mean += fast_exp(log_at[p] - top) / PLACES;
        double common = top + fast_log(mean), higher = most(out[s], common), lower = least(out[s], common);
        out[s] = higher + fast_log(1.0 + fast_exp(lower - higher));
    }
    free(memory);
    return 0;
}

/* `Rays`: F firings, I with returns, G without between returns, E ring ends, O rings without returns. */
typedef struct {
    int64_t firings, inside, gaps, ends, empty_rings, edges;
    const double *direction; /* (3, F) */
    const double *width, *share;
    const int64_t *inside_at, *gaps_at, *last_at, *beyond_at; /* beyond_at: (E, WINDOW) */
    const double *empty;
    double step, reference_azimuth, lost, odd_ends, lost_ring, stray, anywhere, median_width, median_share;
} Rays;

/* Probability (0 to 1) that no firing of a ring without returns returns, wherever in a step they are. */
static double unseen(const Rays *f, int64_t ring, const double *normals, const double *arc, double offset)
{
    int64_t n = f->edges;
    double sine = sin(f->empty[ring]), cosine = cos(f->empty[ring]), right, left, sure_right, sure_left;
    double width = f->median_width, returns = 1.0 - f->stray - f->lost;
    chord(n, arc, sine, cosine, sin(width * (0.5 - offset)), &right, &left);
    if (!(left > right))
        return 1.0;
    chord(n, arc, sine, cosine, sin(-width * (0.5 + offset)), &sure_right, &sure_left);
    if (!(sure_left - sure_right < f->step))
        return 0.0;
    double spacing = most((left - right) / MOST_FIRINGS, f->step), apart = spacing / PHASES, silent[PHASES], mean = 0.0;
    double azimuth = right + 0.5 * apart + f->reference_azimuth;
    double x = cos(azimuth), y = sin(azimuth), turn_x = cos(apart), turn_y = sin(apart);
    for (int p = 0; p < PHASES; p++)
        silent[p] = 1.0;
    for (int j = 0; j < PHASES * MOST_FIRINGS; j++) {
        double outside = -INFINITY;
        for (int64_t k = 0; k < n; k++)
            outside = most(outside, cosine * (normals[3 * k] * x + normals[3 * k + 1] * y) + sine * normals[3 * k + 2]);
        silent[j % PHASES] *= 1.0 - f->stray - returns * least(most(0.5 - offset - outside / width, 0.0), 1.0);
        double next = x * turn_x - y * turn_y;
        y = x * turn_y + y * turn_x;
        x = next;
    }
    double times = spacing / f->step;
    for (int p = 0; p < PHASES; p++)
        mean += (times == 1.0 ? silent[p] : silent[p] > 0.0 ? fast_exp(times * fast_log(most(silent[p], 1e-300))) : 0.0) / PHASES;
    return mean;
}

/* `Rays.log_likelihood` of S polygons (n, 3), with offsets (S,). */
FOR_EVERY_PROCESSOR
int64_t rays_log_likelihood(const Rays *f, int64_t samples, const double *corners, const double *offsets, double *out)
{
    int64_t n = f->edges, F = f->firings;
    double *memory = malloc((size_t)(6 * n + 2 * F) * sizeof(double)), returns = 1.0 - f->stray - f->lost;
    if (!memory)
        return 1;
    double *normals = memory, *arc = normals + 3 * n, *P = arc + 3 * n, *logs = P + F;
    const double *x = f->direction, *y = x + F, *z = y + F;
    for (int64_t s = 0; s < samples; s++) {
        double total = 0.0, offset = offsets[s];
        sight_planes(n, corners + 3 * n * s, normals);
        arcs(n, normals, f->reference_azimuth, arc);
#pragma omp simd
        for (int64_t i = 0; i < F; i++)
            P[i] = normals[0] * x[i] + normals[1] * y[i] + normals[2] * z[i];
        for (int64_t k = 1; k < n; k++) {
            const double a = normals[3 * k], b = normals[3 * k + 1], c = normals[3 * k + 2];
#pragma omp simd
            for (int64_t i = 0; i < F; i++)
                P[i] = most(P[i], a * x[i] + b * y[i] + c * z[i]);
        }
#pragma omp simd
        for (int64_t i = 0; i < F; i++) {
            P[i] = f->stray + returns * least(most(0.5 - P[i] / f->width[i] - offset * f->share[i], 0.0), 1.0);
            logs[i] = fast_log(P[i]);
        }
        for (int64_t i = 0; i < f->inside; i++)
            total += logs[f->inside_at[i]];
        for (int64_t i = 0; i < f->gaps; i++)
            total += fast_log(1.0 - P[f->gaps_at[i]]);
        for (int64_t e = 0; e < f->ends; e++) {
            const int64_t *at = f->beyond_at + WINDOW * e;
            double last = P[f->last_at[e]], some[WINDOW + 1], none[WINDOW + 1]; /* returned before, silent after */
            some[0] = none[WINDOW] = 1.0;
            for (int j = 0; j < WINDOW; j++)
                some[j + 1] = some[j] * P[at[j]];
            for (int j = WINDOW; j-- > 0;)
                none[j] = none[j + 1] * (1.0 - P[at[j]]);
            double usual = none[0], odd = usual * (1.0 - last) / last + f->anywhere;
            for (int j = 1; j < WINDOW; j++)
                odd += some[j] * none[j];
            total += fast_log((1.0 - f->odd_ends) * usual + f->odd_ends / WINDOW * odd);
        }
        for (int64_t o = 0; o < f->empty_rings; o++) {
            double no_return = unseen(f, o, normals, arc, offset * f->median_share);
            total += log_or_least(f->lost_ring + (1.0 - f->lost_ring) * no_return);
        }
        out[s] = total;
    }
    free(memory);
    return 0;
}
