/* Tangent vectors between many rigid transforms: `optshape_graph.se3.difference`, which is the reference. */

#include "vector_math.h"

/* The rotation vector of a rotation, by the unit quaternion whose largest entry is taken first (Shepperd, 1978). */
static double rotation_vector(double R[3][3], double w[3])
{
    double trace = R[0][0] + R[1][1] + R[2][2];
    double of[4] = {1.0 + trace, 1.0 + 2.0 * R[0][0] - trace, 1.0 + 2.0 * R[1][1] - trace, 1.0 + 2.0 * R[2][2] - trace};
    double x = R[2][1] - R[1][2], y = R[0][2] - R[2][0], z = R[1][0] - R[0][1];
    double xy = R[1][0] + R[0][1], xz = R[2][0] + R[0][2], yz = R[2][1] + R[1][2];
    int largest = 0;
    for (int k = 1; k < 4; k++)
        if (of[k] > of[largest])
            largest = k;
    double rows[4][4] = {{of[0], x, y, z}, {x, of[1], xy, xz}, {y, xy, of[2], yz}, {z, xz, yz, of[3]}};
    const double *q = rows[largest];
    double sine = sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), norm = sqrt(q[0] * q[0] + sine * sine);
    double angle = 2.0 * fast_angle(sine, fabs(q[0]));
    double scale = (sine > 1e-150 * norm ? angle / sine : 2.0 / norm) * (q[0] < 0 ? -1.0 : 1.0);
    for (int k = 0; k < 3; k++)
        w[k] = q[k + 1] * scale;
    return sine > 1e-150 * norm ? angle : 0.0;
}

/* xi (count, 6) with B = A Exp(xi), rotation first; A is one transform (4, 4), or one for each B. */
int64_t differences(int64_t count, int64_t one_for_each, const double *A_all, const double *B_all, double *xi_all)
{
    for (int64_t s = 0; s < count; s++) {
        const double *A = A_all + 16 * s * one_for_each, *B = B_all + 16 * s;
        double *xi = xi_all + 6 * s, R[3][3], t[3], off[3] = {B[3] - A[3], B[7] - A[7], B[11] - A[11]};
        for (int i = 0; i < 3; i++) {
            t[i] = A[i] * off[0] + A[4 + i] * off[1] + A[8 + i] * off[2];
            for (int j = 0; j < 3; j++)
                R[i][j] = A[i] * B[j] + A[4 + i] * B[4 + j] + A[8 + i] * B[8 + j];
        }
        double angle = rotation_vector(R, xi), square = angle * angle, c;
        if (angle < 0.2) /* series of (1 - x / 2 cot(x / 2)) / x^2 */
            c = 1.0 / 12 + square * (1.0 / 720 + square * (1.0 / 30240 + square * (1.0 / 1209600 + square / 47900160)));
        else
            c = (1.0 - 0.5 * angle * cos(0.5 * angle) / sin(0.5 * angle)) / square;
        /* V^-1 t = t - w x t / 2 + c w x (w x t) */
        double once[3] = {xi[1] * t[2] - xi[2] * t[1], xi[2] * t[0] - xi[0] * t[2], xi[0] * t[1] - xi[1] * t[0]};
        double twice[3] = {xi[1] * once[2] - xi[2] * once[1], xi[2] * once[0] - xi[0] * once[2],
                           xi[0] * once[1] - xi[1] * once[0]};
        for (int k = 0; k < 3; k++)
            xi[3 + k] = t[k] - 0.5 * once[k] + c * twice[k];
    }
    return 0;
}

/* Sum of L z + b, squared, at a pose T (4, 4); L (12, 12), z = [vec R; t]. */
static double residuals(const double *L, const double *b, const double *T, double *residual)
{
    double sum = 0.0;
    for (int i = 0; i < 12; i++) {
        double r = b[i];
        for (int j = 0; j < 12; j++)
            r += L[12 * i + j] * T[4 * (j % 3) + j / 3];
        residual[i] = r;
        sum += r * r;
    }
    return sum;
}

/* Solve A x = y, A (6, 6) symmetric and positive, by Cholesky; whether it is. */
static int solve_six(double A[6][6], const double *y, double *x)
{
    for (int j = 0; j < 6; j++) {
        for (int i = j; i < 6; i++) {
            double s = A[i][j];
            for (int k = 0; k < j; k++)
                s -= A[i][k] * A[j][k];
            if (i == j && !(s > 0.0))
                return 0;
            A[i][j] = i == j ? sqrt(s) : s / A[j][j];
        }
    }
    for (int i = 0; i < 6; i++) {
        x[i] = y[i];
        for (int k = 0; k < i; k++)
            x[i] -= A[i][k] * x[k];
        x[i] /= A[i][i];
    }
    for (int i = 5; i >= 0; i--) {
        for (int k = i + 1; k < 6; k++)
            x[i] -= A[k][i] * x[k];
        x[i] /= A[i][i];
    }
    return 1;
}

/* `factors.measurement.refine_all`: the poses (count, 4, 4) nearest to starts that minimise |L z + b|^2. */
int64_t nearest_minima(int64_t count, const double *L_all, const double *b_all, const double *starts, int64_t iterations,
                       double *T_all)
{
    for (int64_t s = 0; s < count; s++) {
        const double *L = L_all + 144 * s, *b = b_all + 12 * s;
        double *T = T_all + 16 * s, residual[12], left[12], damping = 1e-12;
        for (int i = 0; i < 16; i++)
            T[i] = starts[16 * s + i];
        double error = residuals(L, b, T, residual);
        for (int64_t iteration = 0; iteration < iterations; iteration++) {
            double J[12][6], A[6][6], y[6], x[6], next[16], trace = 0.0, largest = 0.0;
            for (int i = 0; i < 12; i++)
                for (int k = 0; k < 3; k++) {
                    double turn = 0.0, shift = 0.0;
                    int u = (k + 1) % 3, v = (k + 2) % 3; /* a turn about axis k moves column u by v's, and v by -u's */
                    for (int j = 0; j < 3; j++) {
                        turn += L[12 * i + 3 * u + j] * T[4 * j + v] - L[12 * i + 3 * v + j] * T[4 * j + u];
                        shift += L[12 * i + 9 + j] * T[4 * j + k];
                    }
                    J[i][k] = turn;
                    J[i][3 + k] = shift;
                }
            for (int j = 0; j < 6; j++) {
                y[j] = 0.0;
                for (int i = 0; i < 12; i++)
                    y[j] -= J[i][j] * residual[i];
                for (int k = 0; k < 6; k++) {
                    A[j][k] = 0.0;
                    for (int i = 0; i < 12; i++)
                        A[j][k] += J[i][j] * J[i][k];
                }
                trace += A[j][j];
            }
            for (int j = 0; j < 6; j++)
                A[j][j] += damping * trace;
            if (!solve_six(A, y, x))
                break;
            double square = x[0] * x[0] + x[1] * x[1] + x[2] * x[2], half = 0.5 * sqrt(square);
            double sinc = half > 0.0 ? sin(half) / half : 1.0, first = sinc * cos(half), second = 0.5 * sinc * sinc;
            double E[3][4];
            for (int i = 0; i < 3; i++) {
                int u = (i + 1) % 3, v = (i + 2) % 3;
                for (int j = 0; j < 3; j++)
                    E[i][j] = second * x[i] * x[j] + (i == j ? 1.0 - second * square : 0.0);
                E[i][u] -= first * x[v];
                E[i][v] += first * x[u];
                E[i][3] = x[3 + i];
            }
            for (int i = 0; i < 4; i++)
                for (int j = 0; j < 4; j++)
                    next[4 * i + j] = T[4 * i] * E[0][j] + T[4 * i + 1] * E[1][j] + T[4 * i + 2] * E[2][j]
                                      + (j == 3 ? T[4 * i + 3] : 0.0);
            for (int j = 0; j < 6; j++)
                largest = most(largest, fabs(x[j]));
            double new_error = residuals(L, b, next, left);
            if (new_error <= error) {
                memcpy(T, next, sizeof next);
                memcpy(residual, left, sizeof left);
                error = new_error;
                damping = most(damping / 10, 1e-12);
            } else {
                damping = most(10 * damping, 1e-8);
            }
            if (largest < 1e-9 || damping > 1.0)
                break;
        }
    }
    return 0;
}
