/* Where the rings of a spinning LiDAR cut polygons: `optshape_graph.chords`, which is the reference. */

#ifndef OPTSHAPE_CHORDS_H
#define OPTSHAPE_CHORDS_H

#include "vector_math.h"

/* Outward unit normals of the planes through sensor and edges of a polygon (n, 3): `chords.sight_planes`. */
static inline void sight_planes(int64_t n, const double *corners, double *normals)
{
    double middle[3] = {0};
    for (int64_t k = 0; k < n; k++)
        for (int j = 0; j < 3; j++)
            middle[j] += corners[3 * k + j];
    for (int64_t k = 0; k < n; k++) {
        const double *a = corners + 3 * k, *b = corners + 3 * ((k + 1) % n);
        double x = a[1] * b[2] - a[2] * b[1], y = a[2] * b[0] - a[0] * b[2], z = a[0] * b[1] - a[1] * b[0];
        double inwards = x * middle[0] + y * middle[1] + z * middle[2];
        double scale = (inwards > 0.0 ? -1.0 : inwards < 0.0 ? 1.0 : 0.0) / sqrt(x * x + y * y + z * z);
        normals[3 * k] = x * scale, normals[3 * k + 1] = y * scale, normals[3 * k + 2] = z * scale;
    }
}

/* Polygons as `chords` asks for them: for each edge across, centre, up. */
static inline void arcs(int64_t n, const double *normals, double reference_azimuth, double *arc)
{
    for (int64_t k = 0; k < n; k++) {
        double x = normals[3 * k], y = normals[3 * k + 1], angle = atan2(-y, -x) - reference_azimuth;
        arc[3 * k] = most(sqrt(x * x + y * y), 1e-300);
        arc[3 * k + 1] = angle - 2 * PI * rint(angle / (2 * PI));
        arc[3 * k + 2] = normals[3 * k + 2];
    }
}

/* A ring's chord of a polygon, or of where it is outside by a margin at most: `chords.chords`. */
static inline void chord(int64_t n, const double *arc, double sine, double cosine, double sine_of_margin, double *right, double *left)
{
    *right = -INFINITY, *left = INFINITY;
    for (int64_t k = 0; k < n; k++) {
        double at = (sine_of_margin - arc[3 * k + 2] * sine) / (arc[3 * k] * cosine);
        double half = at < -1.0 ? -INFINITY : PI - acos(least(at, 1.0));
        *right = most(*right, arc[3 * k + 1] - half);
        *left = least(*left, arc[3 * k + 1] + half);
    }
}

#endif
