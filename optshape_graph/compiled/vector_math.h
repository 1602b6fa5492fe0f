/* Exponential, logarithm and the normal distribution's tail, free of branches, so that loops over them become vectors.

   All are good to some units in the last place: arguments are finite, those of logarithms positive and normal. */

#ifndef OPTSHAPE_VECTOR_MATH_H
#define OPTSHAPE_VECTOR_MATH_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#if defined(__GNUC__)
#define INLINE static inline __attribute__((always_inline))
#else
#define INLINE static inline
#endif

/* A function made for several kinds of processors, of which the loader chooses. */
#if defined(__x86_64__) && defined(__ELF__) && defined(__GNUC__) && __GNUC__ >= 12 && !defined(__clang__)
#define FOR_EVERY_PROCESSOR __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define FOR_EVERY_PROCESSOR
#endif

#define SQRT_HALF 0.70710678118654752440
#define PI 3.14159265358979323846
#define LOG_SQRT_2PI 0.91893853320467274178
#define PEAK 0.39894228040143267794 /* of the standard normal density */

INLINE uint64_t bits_of(double x)
{
    uint64_t bits;
    memcpy(&bits, &x, 8);
    return bits;
}

INLINE double of_bits(uint64_t bits)
{
    double x;
    memcpy(&x, &bits, 8);
    return x;
}

INLINE double least(double a, double b) { return a < b ? a : b; }
INLINE double most(double a, double b) { return a > b ? a : b; }

/* exp(x); below exp(-708), and above exp(708), those. */
INLINE double fast_exp(double x)
{
    const double whole = 0x1.8p52; /* a double this large has no fraction: adding it rounds */
    x = least(most(x, -708.0), 708.0);
    double k = x * 1.44269504088896340736 + whole;
    uint64_t power = bits_of(k) << 52;
    k -= whole;
    double r = (x - k * 0x1.62e42fefa3800p-1) - k * 0x1.ef35793c76730p-45;
    double p = 1.0 / 6227020800.0;
    p = p * r + 1.0 / 479001600.0;
    p = p * r + 1.0 / 39916800.0;
    p = p * r + 1.0 / 3628800.0;
    p = p * r + 1.0 / 362880.0;
    p = p * r + 1.0 / 40320.0;
    p = p * r + 1.0 / 5040.0;
    p = p * r + 1.0 / 720.0;
    p = p * r + 1.0 / 120.0;
    p = p * r + 1.0 / 24.0;
    p = p * r + 1.0 / 6.0;
    p = p * r + 0.5;
    p = p * r + 1.0;
    p = p * r + 1.0;
    return p * of_bits(power + 0x3ff0000000000000u);
}

/* log(x) by the series of artanh at (m - 1) / (m + 1), m from sqrt(1/2) to sqrt(2). */
INLINE double fast_log(double x)
{
    uint64_t bits = bits_of(x);
    double e = of_bits((bits >> 52) | 0x4330000000000000u) - (0x1p52 + 1023.0);
    double m = of_bits((bits & 0x000fffffffffffffu) | 0x3ff0000000000000u);
    double above = m > 1.41421356237309504880 ? 1.0 : 0.0;
    m = m * (1.0 - 0.5 * above);
    e += above;
    double s = (m - 1.0) / (m + 1.0), q = s * s;
    double p = 1.0 / 23.0;
    p = p * q + 1.0 / 21.0;
    p = p * q + 1.0 / 19.0;
    p = p * q + 1.0 / 17.0;
    p = p * q + 1.0 / 15.0;
    p = p * q + 1.0 / 13.0;
    p = p * q + 1.0 / 11.0;
    p = p * q + 1.0 / 9.0;
    p = p * q + 1.0 / 7.0;
    p = p * q + 1.0 / 5.0;
    p = p * q + 1.0 / 3.0;
    return e * 0x1.62e42fefa3800p-1 + (2.0 * s + (2.0 * s * q * p + e * 0x1.ef35793c76730p-45));
}

/* atan(y / x) for x, y >= 0, not both 0: the ratio of Cephes (Moshier), about 0 or 1, of the smaller over the larger. */
INLINE double fast_angle(double y, double x)
{
    double low = least(x, y), high = most(x, y), beyond = low > 0.66 * high ? 1.0 : 0.0;
    double t = (low - beyond * high) / (high + beyond * low), q = t * t;
    double top = -8.750608600031904122785e-1, bottom = q + 2.485846490142306297962e1;
    top = top * q - 1.615753718733365076637e1, bottom = bottom * q + 1.650270098316988542046e2;
    top = top * q - 7.500855792314704667340e1, bottom = bottom * q + 4.328810604912902668951e2;
    top = top * q - 1.228866684490136173410e2, bottom = bottom * q + 4.853903996359136964868e2;
    top = top * q - 6.485021904942025371773e1, bottom = bottom * q + 1.945506571482613964425e2;
    double angle = t * q * top / bottom + t + beyond * (0.25 * PI);
    return y > x ? 0.5 * PI - angle : angle;
}

/* exp(t^2) erfc(t) for t >= 0: the ratio of `optshape_graph.gaussian`. */
INLINE double scaled_tail(double t)
{
    double y = 1.0 - 6.0 / (t + 3.0);
    double top = 2.0967984490337273e-05, bottom = 7.126827717278987e-05;
    top = top * y + 0.00046158934781906846, bottom = bottom * y + 0.0010393388326473947;
    top = top * y + 0.0027177091311766993, bottom = bottom * y + 0.007475874675158582;
    top = top * y + 0.01673502829007334, bottom = bottom * y + 0.035061530751930664;
    top = top * y + 0.051309535107367105, bottom = bottom * y + 0.11963947760638417;
    top = top * y + 0.1568048288724029, bottom = bottom * y + 0.3128720694016449;
    top = top * y + 0.3214472433183401, bottom = bottom * y + 0.6473388845332646;
    top = top * y + 0.5453248423610739, bottom = bottom * y + 1.0508068649859599;
    top = top * y + 0.8037742792108247, bottom = bottom * y + 1.3848016150950482;
    top = top * y + 0.658223448396614, bottom = bottom * y + 1.2418227140050702;
    top = top * y + 0.7160046047255596, bottom = bottom * y + 1.0;
    return top / (bottom * (1.0 + t));
}

#endif
