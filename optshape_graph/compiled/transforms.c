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
