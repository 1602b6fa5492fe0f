/* The in-plane pose of every labelling, and the best that differ: `optshape_graph.pose.association`, which is the
   reference. */

#include "vector_math.h"

#include <stdlib.h>

enum { TERMS = 15, ANGLES = 72 }; /* terms of a symmetric (5, 5) matrix, row after row; angles of the grid */

/* What decides which labellings are kept: how many angles are refined, grid steps between directions of rivals, and for
   poses that differ a little and much the turn, rad, the move, in sizes, and how many. */
typedef struct {
    int64_t refined, sector;
    double near_turn, near_move;
    int64_t near_count;
    double far_turn, far_move;
    int64_t far_count;
} Search;

/* A labelling and an angle to refine. */
typedef struct {
    double cost, angle;
    int64_t labelling, order;
} Start;

/* A cost to sort by: what is not a number comes last. */
INLINE double sortable(double cost) { return cost == cost ? cost : INFINITY; }

static int by_cost(const void *a, const void *b)
{
    const Start *x = a, *y = b;
    if (x->cost != y->cost)
        return x->cost < y->cost ? -1 : 1;
    return x->order < y->order ? -1 : x->order > y->order;
}

/* Mark the first `count` of poses that differ from each before by a turn or a move. */
static void keep_different(int64_t n, const double *turn_x, const double *turn_y, const double *y, const double *z,
                           double turn, double move, int64_t count, uint8_t *free_ones, uint8_t *kept)
{
    double least_cosine = cos(turn);
    memset(free_ones, 1, (size_t)n);
    for (int64_t first = 0; first < n && count > 0; first++) {
        if (!free_ones[first])
            continue;
        kept[first] = 1;
        count--;
        for (int64_t i = first; i < n; i++) {
            double cosine = turn_x[i] * turn_x[first] + turn_y[i] * turn_y[first];
            double dy = y[i] - y[first], dz = z[i] - z[first];
            free_ones[i] &= !((cosine > least_cosine) & (dy * dy + dz * dz < move * move));
        }
    }
}

/* The forms [c, s, -1] of a labelling's costs: cc, cs, c1, ss, s1, 11, the shift eliminated, and what gives the shift. */
static void eliminate(const double *sums, double count, double *form, double *by_turn)
{
    /* Rows of the (5, 5) matrix: cosine, sine, y, z, 1. */
    double yy = sums[9] + 1e-9 * count, zz = sums[12] + 1e-9 * count, yz = sums[10];
    double of_y[3] = {sums[2], sums[6], sums[11]}, of_z[3] = {sums[3], sums[7], sums[13]};
    double determinant = yy * zz - yz * yz;
    for (int k = 0; k < 3; k++) {
        by_turn[k] = (zz * of_y[k] - yz * of_z[k]) / determinant;
        by_turn[3 + k] = (yy * of_z[k] - yz * of_y[k]) / determinant;
    }
    const int at[6][2] = {{0, 0}, {0, 1}, {0, 2}, {1, 1}, {1, 2}, {2, 2}};
    const int of[6] = {0, 1, 4, 5, 8, 14};
    for (int k = 0; k < 6; k++) {
        int i = at[k][0], j = at[k][1];
        form[k] = sums[of[k]] - of_y[i] * by_turn[j] - of_z[i] * by_turn[3 + j];
    }
}

/* The best poses of one scan that differ; their number, or -1 where there is no memory.

   labels (labellings, ends) are edges; products (ends, edges, TERMS) the normal matrix of each end were it on each edge.
   The angles and the shifts (y, z), metres, go where there is room for as many as are kept. */
FOR_EVERY_PROCESSOR
int64_t best_poses(const Search *search, int64_t labellings, int64_t ends, int64_t edges, const int64_t *labels,
                   const double *products, double size, double *angles, double *shifts)
{
    int64_t sectors = (ANGLES + search->sector - 1) / search->sector;
    int64_t refined = labellings < search->refined ? labellings : search->refined, starts = refined + sectors;
    double *forms = malloc((size_t)(labellings * 12 + starts * 6) * sizeof(double));
    Start *all = malloc((size_t)(labellings + starts) * sizeof(Start));
    uint8_t *flags = calloc((size_t)starts * 2, 1);
    if (!forms || !all || !flags) {
        free(forms);
        free(all);
        free(flags);
        return -1;
    }
    double grid[6][ANGLES], least_of[ANGLES];
    int64_t best_of[ANGLES] = {0};
    for (int a = 0; a < ANGLES; a++) {
        double c = cos(2 * PI / ANGLES * a), s = sin(2 * PI / ANGLES * a);
        grid[0][a] = c * c, grid[1][a] = 2 * c * s, grid[2][a] = -2 * c, grid[3][a] = s * s, grid[4][a] = -2 * s;
        grid[5][a] = 1.0;
        least_of[a] = INFINITY;
    }
    for (int64_t l = 0; l < labellings; l++) {
        double sums[TERMS] = {0}, values[ANGLES], *form = forms + 12 * l;
        for (int64_t m = 0; m < ends; m++) {
            const double *product = products + TERMS * (m * edges + labels[l * ends + m]);
            for (int k = 0; k < TERMS; k++)
                sums[k] += product[k];
        }
        eliminate(sums, (double)ends, form, form + 6);
#pragma omp simd
        for (int a = 0; a < ANGLES; a++)
            values[a] = form[0] * grid[0][a] + form[1] * grid[1][a] + form[2] * grid[2][a] + form[3] * grid[3][a]
                        + form[4] * grid[4][a] + form[5];
        int best = 0;
        for (int a = 0; a < ANGLES; a++)
            if (values[a] < values[best])
                best = a;
        for (int a = 0; a < ANGLES; a++)
            if (values[a] < least_of[a]) {
                least_of[a] = values[a];
                best_of[a] = l;
            }
        all[l] = (Start){sortable(values[best]), 2 * PI / ANGLES * best, l, l};
    }
    if (refined < labellings)
        qsort(all, (size_t)labellings, sizeof(Start), by_cost);
    Start *some = all + labellings;
    for (int64_t i = 0; i < refined; i++)
        some[i] = all[i];
    for (int64_t i = 0; i < sectors; i++) {
        int64_t a = i * search->sector;
        some[refined + i] = (Start){0.0, 2 * PI / ANGLES * (double)a, best_of[a], 0};
    }
    for (int64_t i = 0; i < starts; i++) {
        const double *f = forms + 12 * some[i].labelling;
        double phi = some[i].angle, c = cos(phi), s = sin(phi);
        for (int newton = 0; newton < 4; newton++) {
            double both = c * s, square = c * c - s * s;
            double slope = (f[3] - f[0]) * both + f[1] * square + f[2] * s - f[4] * c;
            double curvature = (f[3] - f[0]) * square - 4 * f[1] * both + f[2] * c + f[4] * s;
            if (curvature > 0)
                phi -= least(most(slope / curvature, -0.1), 0.1);
            c = cos(phi), s = sin(phi);
        }
        double cost = f[0] * c * c + 2 * f[1] * c * s + f[3] * s * s - 2 * (f[2] * c + f[4] * s) + f[5];
        some[i] = (Start){sortable(cost), phi, some[i].labelling, i};
    }
    qsort(some, (size_t)starts, sizeof(Start), by_cost);

    double *turn_x = forms + 12 * labellings, *turn_y = turn_x + starts, *y = turn_y + starts, *z = y + starts;
    for (int64_t i = 0; i < starts; i++) {
        const double *by_turn = forms + 12 * some[i].labelling + 6;
        turn_x[i] = cos(some[i].angle);
        turn_y[i] = sin(some[i].angle);
        y[i] = (by_turn[2] - by_turn[0] * turn_x[i] - by_turn[1] * turn_y[i]) / size;
        z[i] = (by_turn[5] - by_turn[3] * turn_x[i] - by_turn[4] * turn_y[i]) / size;
    }
    uint8_t *kept = flags + starts;
    keep_different(starts, turn_x, turn_y, y, z, search->near_turn, search->near_move, search->near_count, flags, kept);
    keep_different(starts, turn_x, turn_y, y, z, search->far_turn, search->far_move, search->far_count, flags, kept);
    int64_t count = 0;
    for (int64_t i = 0; i < starts; i++)
        if (kept[i]) {
            angles[count] = some[i].angle;
            shifts[2 * count] = y[i] * size;
            shifts[2 * count + 1] = z[i] * size;
            count++;
        }
    free(forms);
    free(all);
    free(flags);
    return count;
}
