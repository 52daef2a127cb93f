/* The filter of `exact/predicates.py`: what floating point is sure of. */
#ifndef QUASIHARMONIC_PREDICATES_H
#define QUASIHARMONIC_PREDICATES_H

#include <float.h>
#include <math.h>

#include "constants.h"

/* Sign of the orientation of three points where floating point is sure of it, else 0: so for NaN and infinity too. */
static inline int sure_orientation(const double *a, const double *b, const double *c)
{
#if FLT_EVAL_METHOD == 0
    const double left = (a[0] - c[0]) * (b[1] - c[1]), right = (a[1] - c[1]) * (b[0] - c[0]);
    const double det = left - right, bound = (fabs(left) + fabs(right)) * RELATIVE_BOUND + UNDERFLOW_BOUND;
    return (det > bound) - (det < -bound);
#else
    /* Where products are not rounded to doubles, nothing has been shown: all is left to NumPy. */
    (void)a, (void)b, (void)c;
    return 0;
#endif
}

#endif
