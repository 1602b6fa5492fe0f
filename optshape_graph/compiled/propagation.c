/* Expectation propagation over ring ends, one candidate pose after another: `optshape_graph.pose.ends.propagation`.

   The equations, the names and the arrays are those of the Python there, which stays the reference; the tests hold both
   together to rounding. What differs: shifts of noisy rings, each of which moves its own ring's ends only, are eliminated
   instead of dense. */

#include "chords.h"

#include <stdlib.h>

enum { CORE = 8 }; /* unknowns beside the rings' shifts: a pose, the offset across the edges, and the blooming */

/* `RingEnds` of B scans: M ring ends, n edges, K columns of shifts, O rings without returns. */
typedef struct {
    int64_t scans, ends, edges, shifts, silent_rings;
    const uint8_t *there;
    const double *points, *sweep, *leftward, *upward, *beam, *lower, *width, *step, *scatter, *elevation_sd, *azimuth_sd,
        *by_shift, *plane, *normals, *offsets, *vertices, *flatness, *beam_offset, *offset_sd, *lost_ends, *lost_span,
        *azimuth_step, *reference_azimuth, *beam_angle, *lost_rings;
    const uint8_t *silent;
    const double *elevations, *slowest;
} RingEnds;

/* `EdgeGeometry` from C poses. */
typedef struct {
    int64_t *labels;
    double *direction, *residual, *along, *across, *shift, *own, *of_ring, *lifted, *turned;
} Geometry;

/* `Posterior` about C poses, its geometry apart. */
typedef struct {
    double *T, *covariance, *joint, *offset, *inset, *shift, *sigma, *log_likelihood;
} Posterior;

/* The scatter of a single return, in beam widths, and the table of `outermost_return`. */
typedef struct {
    double own;
    int64_t steps;
    const double *step, *shift, *share;
} Scatter;

/* The constants of the model, as the Python has them. */
typedef struct {
    double inwards, grazing, largest_step, damping, weak_prior[6];
} Model;

INLINE double dot(const double *a, const double *b, int n)
{
    double sum = 0.0;
    for (int i = 0; i < n; i++)
        sum += a[i] * b[i];
    return sum;
}

INLINE void cross(const double a[3], const double b[3], double c[3])
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

/* Linear interpolation in a table, its ends beyond it. */
static double interpolate(double x, const double *at, const double *value, int64_t n)
{
    if (x <= at[0])
        return value[0];
    if (x >= at[n - 1])
        return value[n - 1];
    int64_t k = 0;
    while (x >= at[k + 1])
        k++;
    return (value[k + 1] - value[k]) / (at[k + 1] - at[k]) * (x - at[k]) + value[k];
}

/* Edge by which a ray in the plane first leaves the polygon; the nearest line where none is ahead. */
static int64_t exit_edge(const double yz[2], const double outward[2], const double *normals, const double *offsets,
                         int64_t edges)
{
    double scale = 1e-3 * sqrt(outward[0] * outward[0] + outward[1] * outward[1]);
    double soonest = INFINITY, nearest = INFINITY;
    int64_t ahead = -1, near = 0;
    for (int64_t k = 0; k < edges; k++) {
        const double *n = normals + 2 * k;
        double beyond = yz[0] * n[0] + yz[1] * n[1] - offsets[k];
        double speed = outward[0] * n[0] + outward[1] * n[1];
        if (speed > scale && -beyond / speed < soonest) {
            soonest = -beyond / speed;
            ahead = k;
        }
        if (fabs(beyond) < nearest) {
            nearest = fabs(beyond);
            near = k;
        }
    }
    return ahead >= 0 ? ahead : near;
}

/* Look at the ring ends from C poses T (4, 4), of scans; labels -1: the edge that a ring end leaves by first. */
int64_t edge_geometry(const RingEnds *ends, const Scatter *scatter, int64_t poses, const int64_t *scan, const double *T_poses,
                   const Geometry *out)
{
    int64_t M = ends->ends, n_edges = ends->edges;
    for (int64_t c = 0; c < poses; c++) {
        const double *T = T_poses + 16 * c;
        int64_t b = scan[c];
        const double *normals = ends->normals + 2 * n_edges * b, *offsets = ends->offsets + n_edges * b;
        for (int64_t m = 0; m < M; m++) {
            int64_t i = b * M + m, o = c * M + m;
            const double *p = ends->points + 3 * i, *sweep = ends->sweep + 3 * i;
            double ray[3], turning[3];
            for (int k = 0; k < 3; k++) {
                ray[k] = dot(T + 4 * k, p, 3);
                turning[k] = dot(T + 4 * k, sweep, 3);
            }
            double y[3] = {ray[0] + T[3], ray[1] + T[7], ray[2] + T[11]};
            double slope[2] = {ray[1] / ray[0], ray[2] / ray[0]};
            double u[2] = {turning[1] - slope[0] * turning[0], turning[2] - slope[1] * turning[0]};
            int64_t label = out->labels[o];
            if (!ends->there[i])
                label = 0;
            else if (label < 0) {
                double yz[2] = {y[1] - slope[0] * y[0], y[2] - slope[1] * y[0]};
                label = exit_edge(yz, u, normals, offsets, n_edges);
            }
            const double *n = normals + 2 * label;
            double mu = n[0] * slope[0] + n[1] * slope[1];
            double along = n[0] * u[0] + n[1] * u[1], across = ends->beam[i] * sqrt(1.0 + mu * mu);
            double step = fabs(along) * ends->width[i] / across;
            double shift = interpolate(step, scatter->step, scatter->shift, scatter->steps);
            double share = interpolate(step, scatter->step, scatter->share, scatter->steps);
            shift = (shift - ends->beam_offset[b]) * across;
            double direction[3] = {-mu, n[0], n[1]}, lifted = 0.0, turned = 0.0;
            for (int k = 0; k < 3; k++) {
                double by_angle = direction[0] * T[k] + direction[1] * T[4 + k] + direction[2] * T[8 + k];
                lifted += by_angle * ends->upward[3 * i + k];
                turned += by_angle * ends->leftward[3 * i + k];
                out->direction[3 * o + k] = direction[k];
            }
            double up = ends->elevation_sd[i] * lifted, left = ends->azimuth_sd[i] * turned;
            double of_beam = scatter->own * share * across, of_place = ends->scatter[i] * along;
            double flatness = ends->flatness[b];
            out->labels[o] = label;
            out->residual[o] = dot(direction, y, 3) - offsets[label] - shift;
            out->along[o] = along;
            out->across[o] = across;
            out->shift[o] = shift;
            out->of_ring[o] = up * up + left * left;
            out->own[o] = flatness * flatness + of_beam * of_beam + of_place * of_place + out->of_ring[o];
            out->lifted[o] = lifted;
            out->turned[o] = turned;
        }
    }
    return 0;
}

/* Invert a symmetric matrix (n, n), n <= CORE, by L D L^T; return the logarithm of its determinant's size. */
INLINE double invert(const double *A, int n, double *inverse)
{
    double L[CORE][CORE], D[CORE], log_size = 0.0;
    for (int j = 0; j < n; j++) {
        double d = A[j * n + j];
        for (int k = 0; k < j; k++)
            d -= L[j][k] * L[j][k] * D[k];
        D[j] = d;
        log_size += fast_log(fabs(d));
        for (int i = j + 1; i < n; i++) {
            double s = A[i * n + j];
            for (int k = 0; k < j; k++)
                s -= L[i][k] * L[j][k] * D[k];
            L[i][j] = s / d;
        }
    }
    double W[CORE][CORE]; /* L^-1 */
    for (int j = 0; j < n; j++) {
        for (int i = 0; i < j; i++)
            W[i][j] = 0.0;
        W[j][j] = 1.0;
        for (int i = j + 1; i < n; i++) {
            double s = 0.0;
            for (int k = j; k < i; k++)
                s -= L[i][k] * W[k][j];
            W[i][j] = s;
        }
    }
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++) {
            double s = 0.0;
            for (int k = i; k < n; k++)
                s += W[k][i] * W[k][j] / D[k];
            inverse[i * n + j] = inverse[j * n + i] = s;
        }
    return log_size;
}

/* Mean and variance of an exponential density on [0, width]; it is uniform where rate * width is small. */
static void exponential_moments(double rate, double width, double *mean, double *variance)
{
    double x = rate * width;
    if (x < 1e-2) {
        *mean = width * (0.5 - x / 12);
        *variance = most(width * width / 12, 1e-300);
        return;
    }
    double end = 1.0 / expm1(least(x, 700.0));
    *mean = width * (1.0 / x - end);
    *variance = most(width * width * (1.0 / (x * x) - end * (1.0 + end)), 1e-300);
}

/* `truncated_moments` of M Gaussians: logarithm of the mass, mean and variance within intervals. */
INLINE void truncated_moments(int64_t M, const double *restrict mean, const double *restrict variance,
                                     const double *restrict lower, const double *restrict upper,
                                     double *restrict log_mass, double *restrict m_out, double *restrict v_out,
                                     double *restrict far_out)
{
#pragma omp simd
    for (int64_t i = 0; i < M; i++) {
        double sd = sqrt(variance[i]), from = (lower[i] - mean[i]) / sd, to = (upper[i] - mean[i]) / sd;
        int mirrored = from + to > 0.0; /* so that b is nearer to the middle than a, and a is below it */
        double a = mirrored ? -to : from, b = mirrored ? -from : to, width = b - a;
        int inside = b > 0.0;
        double half_square = 0.5 * b * b;
        double at_b = inside ? fast_exp(-half_square) : 1.0; /* of the density at b, or if b is outside, of that there */
        double at_a = at_b * fast_exp(0.5 * width * (a + b));
        double below_a = 0.5 * scaled_tail(SQRT_HALF * fabs(a)) * at_a;
        double beside_b = 0.5 * scaled_tail(SQRT_HALF * fabs(b)) * at_b;
        double mass = (inside ? 1.0 - beside_b : beside_b) - below_a;
        double some = most(mass, 1e-300);
        double density_a = PEAK * at_a / some, density_b = PEAK * at_b / some;
        double m = density_a - density_b, v = 1.0 + a * density_a - b * density_b - m * m;
        log_mass[i] = fast_log(some) - (inside ? 0.0 : half_square);
        far_out[i] = (b < -300.0) | (width < 1e-3) | !(v > 0.0) | !(mass > 1e-300) ? 1.0 : 0.0;
        m = least(most(m, a), b);
        v = least(v, 0.25 * width * width);
        m_out[i] = mean[i] + sd * (mirrored ? -m : m);
        v_out[i] = variance[i] * v;
    }
    /* Far out the density is exponential; in a narrow interval it is uniform, an exponential of a small rate. */
    for (int64_t i = 0; i < M; i++) {
        if (far_out[i] == 0.0)
            continue;
        double sd = sqrt(variance[i]), from = (lower[i] - mean[i]) / sd, to = (upper[i] - mean[i]) / sd;
        int mirrored = from + to > 0.0;
        double a = mirrored ? -to : from, b = mirrored ? -from : to, width = b - a, tail_mean, v;
        exponential_moments(most(-0.5 * (most(a, b - 1.0) + b), 0.0), width, &tail_mean, &v);
        double m = b - tail_mean;
        double at_b = b > 0.0 ? fast_exp(-0.5 * b * b) : 1.0, at_a = at_b * fast_exp(0.5 * width * (a + b));
        double beside_b = 0.5 * scaled_tail(SQRT_HALF * fabs(b)) * at_b;
        double mass = (b > 0.0 ? 1.0 - beside_b : beside_b) - 0.5 * scaled_tail(SQRT_HALF * fabs(a)) * at_a;
        if (!(mass > 0.0 && width >= 1e-3))
            log_mass[i] = fast_log(most(width, 1e-300)) - 0.125 * (a + b) * (a + b) - LOG_SQRT_2PI;
        m_out[i] = mean[i] + sd * (mirrored ? -m : m);
        v_out[i] = variance[i] * v;
    }
}

/* Logarithm of the normal distribution. */
INLINE double log_ndtr(double x)
{
    double t = fabs(x) * SQRT_HALF, scaled = 0.5 * scaled_tail(t);
    double below = fast_log(scaled) - t * t, above = fast_log(1.0 - scaled * fast_exp(-t * t));
    return x < 0.0 ? below : above;
}

/* Move a pose T (4, 4) by Exp(xi), rotation first. */
static void moved(const double *T, const double xi[6], double *out)
{
    double x = xi[0], y = xi[1], z = xi[2], square = x * x + y * y + z * z, angle = sqrt(square), half = 0.5 * angle;
    double sinc = half > 0.0 ? sin(half) / half : 1.0, first = sinc * cos(half), second = 0.5 * sinc * sinc, third;
    if (angle < 0.1) /* series of (x - sin x) / x^3 */
        third = 1.0 / 6.0 - square / 120.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0 * (1.0 - square / 110.0)));
    else
        third = (angle - sin(angle)) / (square * angle);
    double W[3][3] = {{0, -z, y}, {z, 0, -x}, {-y, x, 0}}, E[4][4] = {{0}};
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) {
            double WW = dot(W[i], (double[3]){W[0][j], W[1][j], W[2][j]}, 3), unit = i == j;
            E[i][j] = unit + first * W[i][j] + second * WW;
            E[i][3] += (unit + second * W[i][j] + third * WW) * xi[3 + j];
        }
    }
    E[3][3] = 1.0;
    for (int i = 0; i < 4; i++)
        for (int j = 0; j < 4; j++)
            out[4 * i + j] = T[4 * i] * E[0][j] + T[4 * i + 1] * E[1][j] + T[4 * i + 2] * E[2][j] + T[4 * i + 3] * E[3][j];
}

/* Arrays of M numbers for one candidate. */
enum {
    J_CORE = 0, /* CORE arrays */
    J_FREE = CORE, /* those of the core with each ring's shift eliminated */
    BY_RING = 2 * CORE, R, TAU, NU, OWN, THERE, LOWER0, LOWER1, UPPER0, UPPER1, DENSITY0, DENSITY1, PREDICTION, VARIANCE,
    CAVITY_MEAN, CAVITY_VARIANCE, SEEN, LOG_MASS0, LOG_MASS1, MEAN0, MEAN1, VARIANCE0, VARIANCE1, FAR, PRECISION,
    INFORMATION, LOG_MASS, ARRAYS
};

/* `update_sites`: the Gaussians that stand for intervals, given what all together say of the residuals. */
FOR_EVERY_PROCESSOR
static void update_sites(int64_t M, double *const *at)
{
    const double *restrict prediction = at[PREDICTION], *restrict variance = at[VARIANCE], *restrict tau = at[TAU],
                           *restrict nu = at[NU], *restrict own = at[OWN];
    double *restrict cavity_mean = at[CAVITY_MEAN], *restrict cavity_variance = at[CAVITY_VARIANCE], *restrict seen = at[SEEN];
#pragma omp simd
    for (int64_t i = 0; i < M; i++) {
        double information = 1.0 / variance[i];
        cavity_variance[i] = 1.0 / most(information - tau[i], 1e-4 * information);
        cavity_mean[i] = cavity_variance[i] * (prediction[i] * information - nu[i]);
        seen[i] = cavity_variance[i] + own[i];
    }
    truncated_moments(M, cavity_mean, seen, at[LOWER0], at[UPPER0], at[LOG_MASS0], at[MEAN0], at[VARIANCE0], at[FAR]);
    truncated_moments(M, cavity_mean, seen, at[LOWER1], at[UPPER1], at[LOG_MASS1], at[MEAN1], at[VARIANCE1], at[FAR]);
    const double *restrict log_mass0 = at[LOG_MASS0], *restrict log_mass1 = at[LOG_MASS1], *restrict mean0 = at[MEAN0],
                           *restrict mean1 = at[MEAN1], *restrict variance0 = at[VARIANCE0], *restrict variance1 = at[VARIANCE1],
                           *restrict density0 = at[DENSITY0], *restrict density1 = at[DENSITY1];
    double *restrict precision = at[PRECISION], *restrict information = at[INFORMATION], *restrict log_mass = at[LOG_MASS];
#pragma omp simd
    for (int64_t i = 0; i < M; i++) {
        double weight0 = density0[i] + log_mass0[i], weight1 = density1[i] + log_mass1[i];
        double less = fast_exp(-fabs(weight0 - weight1)), total = 1.0 + less;
        log_mass[i] = most(weight0, weight1) + fast_log(total);
        weight0 = weight0 > weight1 ? 1.0 / total : less / total;
        weight1 = 1.0 - weight0;
        double boundary = weight0 * mean0[i] + weight1 * mean1[i], off0 = mean0[i] - boundary, off1 = mean1[i] - boundary;
        double spread = weight0 * (variance0[i] + off0 * off0) + weight1 * (variance1[i] + off1 * off1);
        double gain = cavity_variance[i] / seen[i], tilted = cavity_mean[i] + gain * (boundary - cavity_mean[i]);
        double tilted_variance = cavity_variance[i] * (1.0 - gain) + gain * gain * spread;
        double informative = 1.0 / tilted_variance - 1.0 / cavity_variance[i], nothing = 1e-6 / seen[i];
        int silent = informative < nothing;
        precision[i] = silent ? nothing : informative;
        information[i] = silent ? 0.0 : tilted / tilted_variance - cavity_mean[i] / cavity_variance[i];
    }
}

/* Sum of a[i] b[i] w[i]. */
INLINE double weighted(int64_t M, const double *restrict a, const double *restrict b, const double *restrict w)
{
    double sum = 0.0;
#pragma omp simd reduction(+ : sum)
    for (int64_t i = 0; i < M; i++)
        sum += a[i] * b[i] * w[i];
    return sum;
}

/* What the shifts of noisy rings leave to the core, and the mean of all. */
typedef struct {
    int64_t rings; /* noisy rings */
    double *pull, *pivot, *shift, *mean; /* (rings, CORE) coupling to the core, (rings) precision, information, mean */
    double covariance[CORE * CORE], core_mean[CORE], log_determinant, mean_times_shift;
} Solved;

/* Solve for mean and covariance of the unknowns, and predict the residuals. */
FOR_EVERY_PROCESSOR
static void solve(int64_t M, double *const *at, const int64_t *ring_of, const double *precision0, const double *shift0,
                  double *weighted_r, Solved *to)
{
    double precision[CORE * CORE], shift[CORE];
    const double *restrict tau = at[TAU], *restrict nu = at[NU], *restrict r = at[R], *restrict by_ring = at[BY_RING];
#pragma omp simd
    for (int64_t i = 0; i < M; i++)
        weighted_r[i] = nu[i] - tau[i] * r[i];
    for (int j = 0; j < CORE; j++) {
        for (int k = 0; k <= j; k++)
            precision[j * CORE + k] = precision0[j * CORE + k] + weighted(M, at[J_CORE + j], at[J_CORE + k], tau);
        const double *restrict J = at[J_CORE + j];
        double sum = 0.0;
#pragma omp simd reduction(+ : sum)
        for (int64_t i = 0; i < M; i++)
            sum += J[i] * weighted_r[i];
        shift[j] = shift0[j] + sum;
    }
    to->log_determinant = to->mean_times_shift = 0.0;
    for (int64_t k = 0; k < to->rings; k++) {
        to->pivot[k] = 1.0;
        to->shift[k] = 0.0;
        for (int j = 0; j < CORE; j++)
            to->pull[k * CORE + j] = 0.0;
    }
    if (to->rings) {
        for (int64_t i = 0; i < M; i++) {
            int64_t k = ring_of[i];
            if (k < 0)
                continue;
            to->pivot[k] += tau[i] * by_ring[i] * by_ring[i];
            to->shift[k] += by_ring[i] * weighted_r[i];
            for (int j = 0; j < CORE; j++)
                to->pull[k * CORE + j] += tau[i] * by_ring[i] * at[J_CORE + j][i];
        }
        for (int64_t k = 0; k < to->rings; k++) {
            const double *pull = to->pull + k * CORE;
            to->log_determinant += fast_log(to->pivot[k]);
            for (int j = 0; j < CORE; j++) {
                shift[j] -= pull[j] * to->shift[k] / to->pivot[k];
                for (int l = 0; l <= j; l++)
                    precision[j * CORE + l] -= pull[j] * pull[l] / to->pivot[k];
            }
        }
    }
    for (int j = 0; j < CORE; j++)
        for (int k = 0; k < j; k++)
            precision[k * CORE + j] = precision[j * CORE + k];
    to->log_determinant += invert(precision, CORE, to->covariance);
    for (int j = 0; j < CORE; j++) {
        to->core_mean[j] = dot(to->covariance + j * CORE, shift, CORE);
        to->mean_times_shift += to->core_mean[j] * shift[j];
    }
    for (int64_t k = 0; k < to->rings; k++) {
        to->mean[k] = (to->shift[k] - dot(to->pull + k * CORE, to->core_mean, CORE)) / to->pivot[k];
        to->mean_times_shift += to->shift[k] * to->shift[k] / to->pivot[k];
    }

    double *const *freed = to->rings ? at + J_FREE : at + J_CORE;
    double *restrict prediction = at[PREDICTION], *restrict variance = at[VARIANCE];
#pragma omp simd
    for (int64_t i = 0; i < M; i++) {
        prediction[i] = r[i];
        variance[i] = 0.0;
    }
    if (to->rings)
        for (int64_t i = 0; i < M; i++) {
            int64_t k = ring_of[i];
            double share = k < 0 ? 0.0 : by_ring[i] / to->pivot[k];
            for (int j = 0; j < CORE; j++)
                freed[j][i] = at[J_CORE + j][i] - (k < 0 ? 0.0 : share * to->pull[k * CORE + j]);
            if (k >= 0) {
                prediction[i] += by_ring[i] * to->mean[k];
                variance[i] = share * by_ring[i];
            }
        }
    for (int j = 0; j < CORE; j++) {
        const double *restrict J = at[J_CORE + j], *restrict F = freed[j];
        double mean = to->core_mean[j], c = to->covariance[j * CORE + j];
#pragma omp simd
        for (int64_t i = 0; i < M; i++) {
            prediction[i] += J[i] * mean;
            variance[i] += c * F[i] * F[i];
        }
        for (int k = 0; k < j; k++) {
            const double *restrict G = freed[k];
            double twice = 2.0 * to->covariance[j * CORE + k];
#pragma omp simd
            for (int64_t i = 0; i < M; i++)
                variance[i] += twice * F[i] * G[i];
        }
    }
}

/* `exit_probability` of one posterior; `inside` has room for a number for each end. */
INLINE double exit_probability(const RingEnds *ends, int64_t b, const double *T, const double *covariance,
                               const double *inset, const double *shift, const int64_t *labels, const double *own,
                               double *inside)
{
    double total = 0.0, floor = fast_log(0.1 * ends->lost_ends[b]);
    const double *normals = ends->normals + 2 * ends->edges * b, *offsets = ends->offsets + ends->edges * b;
    for (int64_t m = 0; m < ends->ends; m++) {
        int64_t i = b * ends->ends + m;
        double ray[3], y[3], turn = inset[m] + shift[m];
        for (int k = 0; k < 3; k++)
            ray[k] = ends->points[3 * i + k] + turn * ends->sweep[3 * i + k];
        double scale = -T[3] / dot(ray, T, 3);
        for (int k = 0; k < 3; k++)
            ray[k] *= scale; /* now the boundary point */
        for (int k = 0; k < 3; k++)
            y[k] = dot(T + 4 * k, ray, 3) + T[4 * k + 3];
        double worst = -INFINITY;
        int64_t edge = 0;
        for (int64_t k = 0; k < ends->edges; k++) {
            double beyond = y[1] * normals[2 * k] + y[2] * normals[2 * k + 1] - offsets[k];
            if (k != labels[m] && beyond > worst) {
                worst = beyond;
                edge = k;
            }
        }
        double J[6], variance = own[m];
        for (int k = 0; k < 3; k++)
            J[3 + k] = normals[2 * edge] * T[4 + k] + normals[2 * edge + 1] * T[8 + k];
        cross(ray, J + 3, J);
        for (int j = 0; j < 6; j++)
            variance += J[j] * dot(covariance + 6 * j, J, 6);
        inside[m] = -worst / sqrt(variance);
    }
    const uint8_t *there = ends->there + b * ends->ends;
#pragma omp simd reduction(+ : total)
    for (int64_t m = 0; m < ends->ends; m++)
        total += there[m] ? most(log_ndtr(inside[m]), floor) : 0.0;
    return total;
}

/* `missed_rings` of one posterior. */
static double missed_rings(const RingEnds *ends, int64_t b, const double *T, double offset, double *corners)
{
    int64_t n = ends->edges, O = ends->silent_rings;
    double lost = ends->lost_rings[b], narrower = 2 * offset * ends->beam_angle[b], total = 0.0;
    if (!O)
        return 0.0;
    for (int64_t k = 0; k < n; k++) {
        const double *v = ends->vertices + 3 * (n * b + k);
        double off[3] = {v[0] - T[3], v[1] - T[7], v[2] - T[11]};
        for (int j = 0; j < 3; j++)
            corners[3 * k + j] = off[0] * T[j] + off[1] * T[4 + j] + off[2] * T[8 + j];
    }
    double *normals = corners + 3 * n, *arc = normals + 3 * n;
    sight_planes(n, corners, normals);
    arcs(n, normals, ends->reference_azimuth[b], arc);
    for (int64_t o = 0; o < O; o++) {
        if (!ends->silent[b * O + o])
            continue;
        double elevation = ends->elevations[b * O + o], right, left;
        chord(n, arc, sin(elevation), cos(elevation), 0.0, &right, &left);
        double steps = (left - right - narrower) / ends->azimuth_step[b];
        if (isnan(steps) || steps == -INFINITY)
            steps = 0.0;
        double unseen = least(most(1.0 - steps, 0.0), 1.0);
        total += fast_log(unseen * (1.0 - lost) + lost);
    }
    return total;
}

/* The posterior about each of C poses of scans, by so many sweeps, and moved to its mean; 1 where there is no memory. */
FOR_EVERY_PROCESSOR
int64_t propagate(const RingEnds *ends, const Model *model, int64_t poses, const int64_t *scan, const double *T_poses,
                  const Geometry *geometry, int64_t sweeps, const Posterior *out)
{
    int64_t M = ends->ends, K = ends->shifts, n = ends->edges, rings = K - 1, wide = (M + 7) / 8 * 8;
    double *memory = calloc((size_t)((ARRAYS + 1) * wide + rings * (CORE + 3) + 9 * n + 1), sizeof(double));
    int64_t *ring_of = malloc((size_t)wide * sizeof(int64_t));
    if (!memory || !ring_of) {
        free(memory);
        free(ring_of);
        return 1;
    }
    double *at[ARRAYS], *next = memory + ARRAYS * wide, *weighted_r = next;
    for (int a = 0; a < ARRAYS; a++)
        at[a] = memory + a * wide;
    Solved solved = {.rings = rings, .pull = next + wide};
    solved.pivot = solved.pull + rings * CORE;
    solved.shift = solved.pivot + rings;
    solved.mean = solved.shift + rings;
    double *corners = solved.mean + rings;

    int64_t of_before = -1;
    for (int64_t c = 0; c < poses; c++) {
        int64_t b = scan[c], o = c * M;
        const double *T = T_poses + 16 * c, *P = ends->plane + 169 * b;
        double precision0[CORE * CORE] = {0}, shift0[CORE] = {0}, prior[36], prior_inverse[36];
        if (b != of_before) {
            for (int64_t m = 0; m < M; m++) {
                const double *by = ends->by_shift + (b * M + m) * K;
                ring_of[m] = -1;
                at[BY_RING][m] = 0.0;
                for (int64_t k = 1; k < K; k++)
                    if (by[k] != 0.0)
                        ring_of[m] = k - 1;
            }
            of_before = b;
        }

        /* The plane: D^T P D, D being the derivative of [vec R; t] by a right perturbation. */
        double D[12][6] = {{0}}, PD[12][6], z[13], gradient[12];
        for (int i = 0; i < 3; i++) {
            double x = T[4 * i], y = T[4 * i + 1], w = T[4 * i + 2];
            D[i][1] = -w, D[i][2] = y, D[3 + i][0] = w, D[3 + i][2] = -x, D[6 + i][0] = -y, D[6 + i][1] = x;
            for (int j = 0; j < 3; j++) {
                D[9 + i][3 + j] = T[4 * i + j];
                z[3 * j + i] = T[4 * i + j];
            }
            z[9 + i] = T[4 * i + 3];
        }
        for (int i = 0; i < 12; i++) {
            gradient[i] = dot(P + 13 * i, z, 12) + P[13 * 12 + i];
            for (int j = 0; j < 6; j++) {
                double s = 0.0;
                for (int k = 0; k < 12; k++)
                    s += P[13 * i + k] * D[k][j];
                PD[i][j] = s;
            }
        }
        for (int i = 0; i < 6; i++) {
            for (int k = 0; k < 12; k++)
                shift0[i] -= gradient[k] * D[k][i];
            for (int j = 0; j < 6; j++) {
                double s = i == j ? model->weak_prior[i] : 0.0;
                for (int k = 0; k < 12; k++)
                    s += D[k][i] * PD[k][j];
                precision0[i * CORE + j] = prior[6 * i + j] = s;
            }
        }
        double offset_information = 1.0 / (ends->offset_sd[b] * ends->offset_sd[b]);
        precision0[6 * CORE + 6] = offset_information;
        precision0[7 * CORE + 7] = 1.0;

        /* The ring ends: derivatives, intervals, and the Gaussians to begin with. */
        double lost = ends->lost_ends[b], first = ends->lost_span[2 * b], last = ends->lost_span[2 * b + 1];
        double log_kept = fast_log(1 - lost), log_lost = fast_log(lost / (last - first));
        for (int64_t m = 0; m < M; m++) {
            int64_t i = b * M + m;
            const double *d = geometry->direction + 3 * (o + m), *p = ends->points + 3 * i;
            double s = geometry->along[o + m], by_angle[3], turn[3];
            for (int k = 0; k < 3; k++)
                by_angle[k] = d[0] * T[k] + d[1] * T[4 + k] + d[2] * T[8 + k];
            cross(p, by_angle, turn);
            for (int k = 0; k < 3; k++) {
                at[J_CORE + k][m] = turn[k];
                at[J_CORE + 3 + k][m] = by_angle[k];
            }
            at[J_CORE + 6][m] = geometry->across[o + m];
            at[J_CORE + 7][m] = s * ends->by_shift[i * K];
            if (ring_of[m] >= 0)
                at[BY_RING][m] = s * ends->by_shift[i * K + 1 + ring_of[m]];
            double lower = ends->lower[i], width = ends->width[i], step = ends->step[i];
            double ends0 = -s * lower, ends1 = -s * (lower + width);
            at[LOWER0][m] = least(ends0, ends1) - 1e-7;
            at[UPPER0][m] = most(ends0, ends1) + 1e-7;
            ends0 = -s * (lower + first * step), ends1 = -s * (lower + last * step);
            at[LOWER1][m] = least(ends0, ends1) - 1e-7;
            at[UPPER1][m] = most(ends0, ends1) + 1e-7;
            double inwards = -s * step / (model->grazing * geometry->across[o + m]);
            at[DENSITY0][m] = log_kept - fast_log(width / step) - model->inwards * least(most(inwards, 0.0), 1.0);
            at[DENSITY1][m] = log_lost;
            double there = ends->there[i] ? 1.0 : 0.0, own = geometry->own[o + m];
            at[THERE][m] = there;
            at[OWN][m] = own;
            at[R][m] = geometry->residual[o + m];
            at[TAU][m] = there / (own + width * width / 12 * s * s);
            at[NU][m] = -at[TAU][m] * (lower + 0.5 * width) * s;
        }

        for (int64_t m = M; m < wide; m++) { /* whole vectors: beside the ends, what has no weight and makes no trouble */
            for (int j = 0; j < CORE; j++)
                at[J_CORE + j][m] = j == 6;
            at[TAU][m] = at[NU][m] = at[R][m] = at[THERE][m] = at[DENSITY0][m] = at[DENSITY1][m] = 0.0;
            at[LOWER0][m] = at[LOWER1][m] = -1.0;
            at[UPPER0][m] = at[UPPER1][m] = at[OWN][m] = 1.0;
            ring_of[m] = -1;
        }

        double *tau = at[TAU], *nu = at[NU];
        const double *there = at[THERE], *r = at[R];
        for (int64_t sweep = 0;; sweep++) {
            solve(wide, at, ring_of, precision0, shift0, weighted_r, &solved);
            update_sites(wide, at);
            if (sweep == sweeps)
                break;
            for (int64_t m = 0; m < M; m++) {
                tau[m] = there[m] * (tau[m] + model->damping * (at[PRECISION][m] - tau[m]));
                nu[m] = there[m] * (nu[m] + model->damping * (at[INFORMATION][m] - nu[m]));
            }
        }
        double evidence = 0.5 * (solved.mean_times_shift - solved.log_determinant);
        double log_prior = invert(prior, 6, prior_inverse) + fast_log(offset_information);
        for (int i = 0; i < 6; i++)
            evidence -= 0.5 * shift0[i] * dot(prior_inverse + 6 * i, shift0, 6);
        evidence += 0.5 * log_prior;
        const double *cavity_variance = at[CAVITY_VARIANCE], *cavity_mean = at[CAVITY_MEAN], *log_mass = at[LOG_MASS];
#pragma omp simd reduction(+ : evidence)
        for (int64_t m = 0; m < wide; m++) {
            double precision = 1.0 / cavity_variance[m], total = precision + tau[m];
            double mean = cavity_mean[m], shift = mean * precision + nu[m];
            double ratio = fast_log(total / precision) - shift * shift / total + mean * mean * precision;
            evidence += there[m] * (log_mass[m] + 0.5 * ratio) - 0.5 * (tau[m] * r[m] * r[m] - 2 * nu[m] * r[m]);
        }

        /* The results. */
        double xi[6], largest = 1e-12, *covariance = out->covariance + 36 * c;
        for (int k = 0; k < 3; k++)
            largest = most(largest, fabs(solved.core_mean[k]));
        double share = least(1.0, model->largest_step / largest);
        for (int k = 0; k < 6; k++)
            xi[k] = solved.core_mean[k] * share;
        moved(T, xi, out->T + 16 * c);
        for (int i = 0; i < 7; i++)
            for (int j = 0; j < 7; j++) {
                out->joint[49 * c + 7 * i + j] = solved.covariance[i * CORE + j];
                if (i < 6 && j < 6)
                    covariance[6 * i + j] = solved.covariance[i * CORE + j];
            }
        out->offset[c] = solved.core_mean[6];
        for (int64_t m = 0; m < M; m++) {
            int64_t i = b * M + m;
            double s = geometry->along[o + m], precision = ends->there[i] ? tau[m] : 1.0, step = ends->step[i];
            double inset = fabs(s) > ends->slowest[i] ? -(nu[m] / precision) / s : 0.0;
            out->inset[o + m] = least(most(inset, ends->lower[i] + first * step), ends->lower[i] + last * step);
            out->shift[o + m] = ends->by_shift[i * K] * solved.core_mean[7];
            if (ring_of[m] >= 0)
                out->shift[o + m] += ends->by_shift[i * K + 1 + ring_of[m]] * solved.mean[ring_of[m]];
            out->sigma[o + m] = 1.0 / sqrt(precision);
        }
        /* What the posterior leaves out. */
        evidence += exit_probability(ends, b, out->T + 16 * c, covariance, out->inset + o, out->shift + o,
                                     geometry->labels + o, geometry->own + o, at[VARIANCE]);
        evidence += missed_rings(ends, b, out->T + 16 * c, out->offset[c], corners);
        out->log_likelihood[c] = isfinite(evidence) ? evidence : -INFINITY;
    }
    free(memory);
    free(ring_of);
    return 0;
}
