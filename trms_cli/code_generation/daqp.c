/* ------------------------------------------------------------------------------------------
 * Quadratic program: DAQP, a dual active-set solver for dense problems.
 *
 *     min  1/2 z'Hz + g'z + sum over soft rows of (w |v| + v^2 / (2 rho))
 *     s.t. lower <= (z; A z + v) <= upper,    v = 0 in hard rows
 *
 * D. Arnstroem, A. Bemporad, D. Axehill, "A dual active-set solver for embedded quadratic
 * programming using recursive LDL' updates", IEEE Trans. Automatic Control 67(8), 2022.
 *
 * This is an extract of DAQP 0.11.0 (https://github.com/darnstrom/daqp), from src/daqp.c,
 * src/auxiliary.c, src/factorization.c and src/utils.c. It decides as the original does.
 * Changed: memory comes from the caller, the Hessian is dense and positive definite and given
 * by its lower triangle (the original regularises others, here the solve fails), the pivoting
 * of the LDL' factors keeps a list instead of calling itself. Left out: binary constraints,
 * hierarchies, variational inequalities, proximal steps, elimination of equalities, timers.
 *
 * MIT License
 *
 * Copyright (c) 2022 Daniel Arnstroem
 *
 * Permission is hereby granted, free of charge, to any person obtaining a copy
 * of this software and associated documentation files (the "Software"), to deal
 * in the Software without restriction, including without limitation the rights
 * to use, copy, modify, merge, publish, distribute, sublicense, and/or sell
 * copies of the Software, and to permit persons to whom the Software is
 * furnished to do so, subject to the following conditions:
 *
 * The above copyright notice and this permission notice shall be included in all
 * copies or substantial portions of the Software.
 *
 * THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR
 * IMPLIED, INCLUDING BUT NOT LIMITED TO THE WARRANTIES OF MERCHANTABILITY,
 * FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE
 * AUTHORS OR COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER
 * LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR OTHERWISE, ARISING FROM,
 * OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE
 * SOFTWARE.
 * ------------------------------------------------------------------------------------------ */

#define QP_NONE (-1)
#define QP_INF 1e30
#ifndef QP_PRIMAL_TOL
#define QP_PRIMAL_TOL 1e-6 /* rows may be off by so much in their units */
#endif
#define QP_DUAL_TOL 1e-12
#define QP_ZERO_TOL 1e-11
#define QP_PROGRESS_TOL 1e-14
#define QP_PIVOT_TOL 1e-8
#define QP_CYCLE_TOL 10
#define QP_SING_TOL 3.7e-11
#define QP_REFACTOR_TOL 1e-9
#define QP_SOFT_CURV_TOL 1.5e-8
#define QP_REFINE_COND 1e6
#define QP_REFINE_GAIN 1e3
#define QP_REFINE_PIVOT 1e-6
#define QP_PIVOT_REFINE_GAIN 1e2
#define QP_PIVOT_REFINE_DECREASE 0.1
#define QP_ADD_NOISE_GAIN 10
#define QP_COND_EPS 0.1

#define QP_SUM(x) ((x) * ((x) + 1) / 2)
#define QP_ROW(i, n) (((2 * (n) - (i) - 1) * (i)) / 2)

enum {
    QP_INEXACT = 4,
    QP_SOFT_OPTIMAL = 2,
    QP_OPTIMAL = 1,
    QP_INFEASIBLE = -1,
    QP_CYCLE = -2,
    QP_ITERATION_LIMIT = -4,
    QP_NONCONVEX = -5,
    QP_OVERDETERMINED = -6
};

/* State of a constraint. */
enum {
    QP_ACTIVE = 1,
    QP_LOWER = 2,
    QP_IMMUTABLE = 4,
    QP_SOFT = 8,
    QP_SLACK_FIXED = 32,
    QP_AUTO_EQUALITY = 128,
    QP_SLACK_SWITCHED = 256,
    QP_ZERO_ROW = 2048
};
#define QP_IS(w, i, what) ((w)->sense[i] & (what))
#define QP_SLACK_FREE(w, i) (((w)->sense[i] & QP_SLACK_FIXED) == 0)
#define QP_ZERO_ROW_MARK(s)                                                                       \
    (QP_IMMUTABLE | QP_ZERO_ROW | ((s) & QP_LOWER) | (((s) & QP_ACTIVE) << 12) |                  \
     (((s) & (QP_IMMUTABLE | QP_SOFT)) << 11))
#define QP_ZERO_ROW_SENSE(s)                                                                      \
    (((s) & QP_ZERO_ROW) ? ((s) & QP_LOWER) | (((s) >> 12) & QP_ACTIVE) |                         \
                               (((s) >> 11) & (QP_IMMUTABLE | QP_SOFT))                           \
                         : (s))

typedef struct {
    int n, m, ms; /* unknowns, constraints, simple bounds among them */
    int iteration_limit;
    const double *H, *f, *A, *upper, *lower; /* H: (n, n), its lower triangle */
    const double *rho, *w;                   /* of the soft rows, by constraint */
    int *sense;                              /* kept from solve to solve: the warm start */

    double *M, *dupper, *dlower, *Rinv, *v, *scaling;
    double *x, *lam, *lam_star, *u, *L, *D, *xldl, *zldl;
    int *WS, *waiting;
    double *waiting_lam;
    double fval;
    int reuse_ind, n_active, sing_ind, iterations, ill_conditioned, noise_floor;
} qp_work;

static double qp_dot(const double *a, const double *b, int n) {
    double s0 = 0, s1 = 0, s2 = 0, s3 = 0;
    int i;
    for (i = 0; i + 3 < n; i += 4) {
        s0 += a[i] * b[i];
        s1 += a[i + 1] * b[i + 1];
        s2 += a[i + 2] * b[i + 2];
        s3 += a[i + 3] * b[i + 3];
    }
    for (; i < n; i++) s0 += a[i] * b[i];
    return (s0 + s1) + (s2 + s3);
}

static void qp_reset(qp_work *work) {
    work->sing_ind = QP_NONE;
    work->n_active = 0;
    work->reuse_ind = 0;
}

/* -- soft rows ----------------------------------------------------------------------------- */

static double qp_soft_rho(const qp_work *work, int id) {
    return work->rho[id] * work->scaling[id] * work->scaling[id];
}

static double qp_soft_w(const qp_work *work, int id) { return work->w[id] / work->scaling[id]; }

static double qp_soft_residual(const qp_work *work, int id, double lam) {
    const double w = qp_soft_w(work, id);
    if (w == 0) return lam == 0 ? 0 : qp_soft_rho(work, id) * lam;
    return qp_soft_rho(work, id) * (lam + (QP_IS(work, id, QP_LOWER) ? w : -w));
}

static double qp_soft_penalty(const qp_work *work, int id, double lam) {
    const double w = qp_soft_w(work, id);
    if (w == 0) return qp_soft_rho(work, id) * lam * lam;
    if (!QP_SLACK_FREE(work, id)) return 0;
    return qp_soft_rho(work, id) * (lam * lam - w * w);
}

static double qp_largest_slack(const qp_work *work) {
    double largest = 0;
    int i;
    for (i = 0; i < work->n_active; i++) {
        const int id = work->WS[i];
        double s;
        if (!QP_IS(work, id, QP_SOFT) || !QP_SLACK_FREE(work, id)) continue;
        s = fabs(qp_soft_residual(work, id, work->lam_star[i])) / work->scaling[id];
        if (s > largest) largest = s;
    }
    return largest;
}

/* -- LDL' factors of the working set ------------------------------------------------------- */

static void qp_solve_Lt(const double *L, double *x, int n) {
    int i, j;
    for (i = n - 1; i > 0; i--) {
        const double xi = x[i];
        const double *Li = L + QP_SUM(i);
        for (j = 0; j < i; j++) x[j] -= Li[j] * xi;
    }
}

static void qp_solve_working_set(qp_work *work) {
    int i, j, disp;
    const int na = work->n_active;
    for (i = 0, disp = 0; i < na; i++) {
        double sum = work->xldl[i];
        for (j = 0; j < i; j++) sum -= work->L[disp++] * work->xldl[j];
        disp++;
        work->xldl[i] = sum;
    }
    for (i = 0; i < na; i++) work->zldl[i] = work->xldl[i] / work->D[i];
    for (i = 0; i < na; i++) work->xldl[i] = work->zldl[i];
    qp_solve_Lt(work->L, work->xldl, na);
}

/* Row of constraint `id` in the space of u; `*start` is its first entry that is not zero. */
static const double *qp_row(const qp_work *work, int id, int *start) {
    if (id < work->ms) {
        *start = id;
        return work->Rinv + QP_ROW(id, work->n);
    }
    *start = 0;
    return work->M + work->n * (id - work->ms);
}

static void qp_sub_rows(const qp_work *work, const double *dlam, double *y) {
    int i, j, start;
    for (i = 0; i < work->n_active; i++) {
        const double *row = qp_row(work, work->WS[i], &start);
        const double dl = dlam[i];
        for (j = start; j < work->n; j++) y[j] -= row[j] * dl;
    }
}

static double qp_row_dot(const qp_work *work, int id, const double *v) {
    int start;
    const double *row = qp_row(work, id, &start);
    return qp_dot(row + start, v + start, work->n - start);
}

/* Recompute a suspicious pivot from an explicit residual; only "singular" changes the factors. */
static void qp_refine_pivot(qp_work *work, int add_ind, int L_start) {
    int i, j, disp, it, start;
    const int k = work->n_active, n = work->n;
    double *c = work->L + L_start, *l = c + k + 1, *r = work->zldl, rr[2];
    work->reuse_ind = 0;
    for (i = 0; i < k; i++) l[i] = c[i];
    qp_solve_Lt(work->L, c, k);
    for (it = 0; it < 2; it++) {
        const double *row = qp_row(work, add_ind, &start);
        for (j = 0; j < n; j++) r[j] = j < start ? 0 : row[j];
        qp_sub_rows(work, c, r);
        for (j = 0, rr[it] = 0; j < n; j++) rr[it] += r[j] * r[j];
        if (it == 1) break;
        for (i = 0; i < k; i++) work->xldl[i] = -qp_row_dot(work, work->WS[i], r);
        qp_solve_working_set(work);
        for (i = 0; i < k; i++) c[i] -= work->xldl[i];
    }
    if (rr[1] >= QP_PIVOT_REFINE_DECREASE * rr[0]) {
        for (i = 0; i < k; i++) c[i] = l[i];
        return;
    }
    work->D[k] = 0;
    for (j = 0; j < k; j++)
        for (i = j + 1, disp = QP_SUM(i) + j; i < k; disp += ++i) c[j] += work->L[disp] * c[i];
}

static void qp_ldl_add(qp_work *work, int add_ind, double rho) {
    int i, j, disp, start, other, free_slacks = 0;
    const int L_start = QP_SUM(work->n_active), n = work->n;
    const double *Mi = qp_row(work, add_ind, &start);
    double sum = qp_dot(Mi + start, Mi + start, n - start);
    work->sing_ind = QP_NONE;
    if (rho != 0) {
        sum += rho;
        free_slacks++;
    }
    work->D[work->n_active] = sum;
    if (work->n_active == 0) {
        if (sum < QP_SING_TOL || n + free_slacks <= 0) work->sing_ind = 0;
        return;
    }
    for (i = 0; i < work->n_active; i++) {
        const int id = work->WS[i];
        const double *Mk = qp_row(work, id, &other);
        if (QP_IS(work, id, QP_SOFT) && QP_SLACK_FREE(work, id)) free_slacks++;
        j = start > other ? start : other;
        work->L[L_start + i] = qp_dot(Mk + j, Mi + j, n - j);
    }
    for (i = 0, disp = 0; i < work->n_active; i++) {
        sum = work->L[L_start + i];
        for (j = 0; j < i; j++) sum -= work->L[disp++] * work->L[L_start + j];
        work->L[L_start + i] = sum;
        disp++;
    }
    sum = work->D[work->n_active];
    for (i = 0, disp = L_start; i < work->n_active; i++, disp++) {
        const double before = work->L[disp];
        work->L[disp] /= work->D[i];
        sum -= before * work->L[disp];
    }
    work->D[work->n_active] = sum;
    if (rho == 0 && free_slacks == 0 && sum >= QP_SING_TOL && work->n_active < n) {
        double min_D = 1;
        for (i = 0; i < work->n_active; i++)
            if (work->D[i] < min_D) min_D = work->D[i];
        if (sum * min_D < QP_PIVOT_REFINE_GAIN * DBL_EPSILON)
            qp_refine_pivot(work, add_ind, L_start);
    }
    if (work->D[work->n_active] < QP_SING_TOL || work->n_active >= n + free_slacks)
        work->sing_ind = work->n_active;
}

static void qp_ldl_remove(qp_work *work, int rm_ind) {
    int i, j, r, old_disp, new_disp, w_count = 0;
    const int n_update = work->n_active - rm_ind - 1;
    double *w = &work->zldl[rm_ind];
    double p, beta, dbar, alpha = work->D[rm_ind];
    if (n_update == 0) return;
    new_disp = QP_SUM(rm_ind);
    old_disp = new_disp + (rm_ind + 1);
    for (i = rm_ind + 1; i < work->n_active; old_disp++, new_disp++, i++)
        for (j = 0; j < i; j++) {
            if (j != rm_ind) work->L[new_disp++] = work->L[old_disp++];
            else w[w_count++] = work->L[old_disp++];
        }
    /* Algorithm C1 of Gill et al. 1974 */
    old_disp = QP_SUM(rm_ind) + rm_ind;
    for (j = 0, i = rm_ind + 1; j < n_update; j++, i++) {
        p = w[j];
        dbar = work->D[i] + alpha * p * p;
        work->D[i - 1] = dbar;
        beta = p * alpha / dbar;
        alpha = work->D[i] * alpha / dbar;
        old_disp += i;
        for (r = j + 1, new_disp = old_disp + j; r < n_update; r++) {
            w[r] -= p * work->L[new_disp];
            work->L[new_disp] += beta * w[r];
            new_disp += rm_ind + r + 1;
        }
    }
}

/* Take a constraint out of the working set, without pivoting. */
static void qp_take_out(qp_work *work, int rm_ind) {
    int i;
    work->sense[work->WS[rm_ind]] &= ~QP_ACTIVE;
    qp_ldl_remove(work, rm_ind);
    work->n_active--;
    for (i = rm_ind; i < work->n_active; i++) {
        work->WS[i] = work->WS[i + 1];
        work->lam[i] = work->lam[i + 1];
    }
    if (rm_ind < work->reuse_ind) work->reuse_ind = rm_ind;
    if (work->n_active > 0 && work->D[work->n_active - 1] < QP_SING_TOL)
        work->sing_ind = work->n_active - 1;
}

/* Put a constraint in, with the slack state that is marked, without pivoting. */
static void qp_put_in(qp_work *work, int add_ind, double lam) {
    work->sense[add_ind] |= QP_ACTIVE;
    qp_ldl_add(work, add_ind,
               QP_IS(work, add_ind, QP_SOFT) && QP_SLACK_FREE(work, add_ind)
                   ? qp_soft_rho(work, add_ind)
                   : 0);
    work->WS[work->n_active] = add_ind;
    work->lam[work->n_active] = lam;
    work->n_active++;
}

static int qp_should_pivot(const qp_work *work) {
    const int rm_ind = work->n_active - 2;
    double l, d_rm, d_last;
    if (work->n_active <= 1 || work->sing_ind != QP_NONE) return 0;
    d_rm = work->D[rm_ind];
    d_last = work->D[work->n_active - 1];
    if (!(d_rm < QP_PIVOT_TOL && d_rm < d_last)) return 0;
    l = work->L[QP_SUM(work->n_active - 1) + rm_ind];
    return !(d_rm * d_last < QP_SING_TOL * (d_last + l * l * d_rm));
}

/* Swap the last two constraints where that makes a better pivot. Constraints that were taken out
 * wait in a list until those before them are in order: at most all of the working set. */
static void qp_pivot_last(qp_work *work) {
    int waiting = 0;
    for (;;) {
        if (qp_should_pivot(work)) {
            const int rm_ind = work->n_active - 2;
            work->waiting[waiting] = work->WS[rm_ind];
            work->waiting_lam[waiting++] = work->lam[rm_ind];
            qp_take_out(work, rm_ind);
        } else if (waiting > 0) {
            waiting--;
            qp_put_in(work, work->waiting[waiting], work->waiting_lam[waiting]);
        } else {
            return;
        }
        if (work->sing_ind != QP_NONE) return;
    }
}

static void qp_remove(qp_work *work, int rm_ind) {
    qp_take_out(work, rm_ind);
    qp_pivot_last(work);
}

static void qp_add_keeping_slack(qp_work *work, int add_ind, double lam) {
    qp_put_in(work, add_ind, lam);
    qp_pivot_last(work);
}

static void qp_add(qp_work *work, int add_ind, double lam) {
    work->sense[add_ind] &= ~QP_SLACK_SWITCHED;
    if (QP_IS(work, add_ind, QP_SOFT)) {
        const double w = qp_soft_w(work, add_ind);
        const int lower = QP_IS(work, add_ind, QP_LOWER);
        if (w > 0) {
            double magnitude;
            work->sense[add_ind] &= ~QP_IMMUTABLE;
            magnitude = (lower ? -lam : lam) >= w ? w : 0;
            lam = lower ? -magnitude : magnitude;
        }
        if (w > 0 && (lower ? -lam : lam) < w) work->sense[add_ind] |= QP_SLACK_FIXED;
        else work->sense[add_ind] &= ~QP_SLACK_FIXED;
    }
    qp_add_keeping_slack(work, add_ind, lam);
}

/* -- iterations ---------------------------------------------------------------------------- */

static void qp_compute_fval(qp_work *work) {
    int i, j;
    double fval = 0;
    for (i = 0; i < work->n_active; i++)
        if (QP_IS(work, work->WS[i], QP_SOFT))
            fval += qp_soft_penalty(work, work->WS[i], work->lam_star[i]);
    for (j = 0; j < work->n; j++) fval += work->u[j] * work->u[j];
    work->fval = fval;
}

static void qp_compute_primal(qp_work *work) {
    int i, j;
    for (j = 0; j < work->n; j++) work->u[j] = 0;
    qp_sub_rows(work, work->lam_star, work->u);
    for (i = 0; i < work->n_active; i++)
        if (QP_IS(work, work->WS[i], QP_SOFT)) work->sense[work->WS[i]] &= ~QP_SLACK_SWITCHED;
    qp_compute_fval(work);
}

/* Level of rounding below which violations count as none, after persistent cycling. */
static double qp_noise(const qp_work *work) {
    double s = 0;
    int i;
    if (!work->noise_floor) return 0;
    for (i = 0; i < work->n_active; i++) s += fabs(work->lam_star[i]);
    return -QP_ADD_NOISE_GAIN * DBL_EPSILON * s;
}

static int qp_add_infeasible(qp_work *work) {
    int j, start, upper_side = 0, add_ind = QP_NONE;
    double least = 0.0, *swap;
    const double noise = qp_noise(work);
    for (j = 0; j < work->m; j++) {
        const double *row;
        double Mu, bound, candidate;
        if (QP_IS(work, j, QP_ACTIVE | QP_IMMUTABLE)) continue;
        row = qp_row(work, j, &start);
        Mu = qp_dot(row + start, work->u + start, work->n - start);
        bound = -QP_PRIMAL_TOL * work->scaling[j];
        if (bound > noise) bound = noise;
        candidate = work->dupper[j] - Mu;
        if (candidate < least && candidate < bound) {
            add_ind = j;
            upper_side = 1;
            least = candidate;
        } else {
            candidate = Mu - work->dlower[j];
            if (candidate < least && candidate < bound) {
                add_ind = j;
                upper_side = 0;
                least = candidate;
            }
        }
    }
    if (add_ind == QP_NONE) return 0;
    if (upper_side) work->sense[add_ind] &= ~QP_LOWER;
    else work->sense[add_ind] |= QP_LOWER;
    swap = work->lam;
    work->lam = work->lam_star;
    work->lam_star = swap;
    qp_add(work, add_ind, upper_side ? -least : least);
    return 1;
}

static double qp_soft_curvature(const qp_work *work) {
    double c = 0, ps = 0, pp = 0;
    int i;
    for (i = 0; i <= work->sing_ind; i++) {
        const int id = work->WS[i];
        const double p2 = work->lam_star[i] * work->lam_star[i];
        pp += p2;
        if (QP_IS(work, id, QP_SOFT) && QP_SLACK_FREE(work, id)) {
            c += qp_soft_rho(work, id) * p2;
            ps += p2;
        }
    }
    return ps > QP_SOFT_CURV_TOL * pp ? c : 0;
}

/* Step the multipliers until one reaches zero or passes its linear price; 0 for a full step. */
static int qp_remove_blocking(qp_work *work) {
    int i, ind, release, free_slacks = 0, rm_ind = QP_NONE;
    const int singular = work->sing_ind != QP_NONE;
    double alpha = QP_INF, y, y_star, p, target, rm_target = 0, lam;
    const double tol = singular ? QP_ZERO_TOL : QP_DUAL_TOL;
    for (i = 0; i < work->n_active; i++) {
        int lower;
        double candidate;
        ind = work->WS[i];
        if (QP_IS(work, ind, QP_IMMUTABLE)) continue;
        lower = QP_IS(work, ind, QP_LOWER);
        y_star = lower ? -work->lam_star[i] : work->lam_star[i];
        if (!QP_IS(work, ind, QP_SOFT)) {
            if (y_star >= -tol) continue;
            target = 0;
        } else {
            const double w = qp_soft_w(work, ind);
            const int fixed = !QP_SLACK_FREE(work, ind);
            target = fixed ? 0 : w;
            if (y_star >= (singular ? 0 : target) - tol) {
                if (!fixed || w == 0 || y_star <= (singular ? 0 : w) + tol) continue;
                target = w;
            }
            if (!singular && w > 0 && target == w && QP_IS(work, ind, QP_SLACK_SWITCHED) &&
                (lower ? -work->lam[i] : work->lam[i]) == w)
                continue;
        }
        y = lower ? -work->lam[i] : work->lam[i];
        p = singular ? y_star : y_star - y;
        candidate = (target - y) / p;
        if (target != 0 && candidate < 0) candidate = 0;
        if (candidate < alpha) {
            alpha = candidate;
            rm_ind = i;
            rm_target = target;
        }
    }
    if (rm_ind == QP_NONE) {
        if (singular) {
            const double c = qp_soft_curvature(work);
            if (c > 0) {
                if (work->D[work->sing_ind] < c) work->D[work->sing_ind] = c;
                if (work->reuse_ind > work->sing_ind) work->reuse_ind = work->sing_ind;
                work->sing_ind = QP_NONE;
                return 1;
            }
        }
        return 0;
    }
    if (singular && alpha <= 0) rm_target = 0;
    for (i = 0; i < work->n_active; i++)
        work->lam[i] += alpha * (singular ? work->lam_star[i] : work->lam_star[i] - work->lam[i]);
    work->sing_ind = QP_NONE;
    ind = work->WS[rm_ind];
    if (rm_target == 0) {
        qp_remove(work, rm_ind);
        for (i = 0; i < work->n_active; i++) work->sense[work->WS[i]] &= ~QP_SLACK_SWITCHED;
        return 1;
    }
    lam = QP_IS(work, ind, QP_LOWER) ? -rm_target : rm_target;
    release = !QP_SLACK_FREE(work, ind);
    if (release) work->sense[ind] &= ~QP_SLACK_FIXED;
    else work->sense[ind] |= QP_SLACK_FIXED;
    work->sense[ind] |= QP_SLACK_SWITCHED;
    if (rm_ind == work->n_active - 1 && !singular) {
        const double rho = qp_soft_rho(work, ind);
        work->D[rm_ind] += release ? rho : -rho;
        work->lam[rm_ind] = lam;
        if (work->reuse_ind > rm_ind) work->reuse_ind = rm_ind;
        for (i = 0; i < work->n_active; i++)
            if (QP_IS(work, work->WS[i], QP_SOFT) && QP_SLACK_FREE(work, work->WS[i]))
                free_slacks++;
        if (work->D[rm_ind] < QP_SING_TOL || rm_ind >= work->n + free_slacks)
            work->sing_ind = rm_ind;
        else qp_pivot_last(work);
    } else {
        qp_remove(work, rm_ind);
        if (work->sing_ind == QP_NONE) qp_add_keeping_slack(work, ind, lam);
    }
    return 1;
}

static void qp_compute_multipliers(qp_work *work) {
    int i, j, disp;
    for (i = work->reuse_ind, disp = QP_SUM(work->reuse_ind); i < work->n_active; i++) {
        const int id = work->WS[i];
        double sum = QP_IS(work, id, QP_LOWER) ? -work->dlower[id] : -work->dupper[id];
        if (QP_IS(work, id, QP_SOFT) && QP_SLACK_FREE(work, id))
            sum -= qp_soft_residual(work, id, 0);
        for (j = 0; j < i; j++) sum -= work->L[disp++] * work->xldl[j];
        disp++;
        work->xldl[i] = sum;
    }
    for (i = work->reuse_ind; i < work->n_active; i++) work->zldl[i] = work->xldl[i] / work->D[i];
    for (i = 0; i < work->n_active; i++) work->lam_star[i] = work->zldl[i];
    qp_solve_Lt(work->L, work->lam_star, work->n_active);
    work->reuse_ind = work->n_active;
}

static void qp_compute_singular_direction(qp_work *work) {
    int i, flip;
    const int id = work->WS[work->sing_ind], L_start = QP_SUM(work->sing_ind);
    const int lower = QP_IS(work, id, QP_LOWER);
    for (i = 0; i < work->sing_ind; i++) work->lam_star[i] = -work->L[L_start + i];
    qp_solve_Lt(work->L, work->lam_star, work->sing_ind);
    work->lam_star[work->sing_ind] = 1;
    flip = lower;
    if (QP_IS(work, id, QP_SOFT) && !QP_SLACK_FREE(work, id)) {
        const double w = qp_soft_w(work, id);
        const double y = lower ? -work->lam[work->sing_ind] : work->lam[work->sing_ind];
        if (w > 0 && y >= w - QP_DUAL_TOL) flip = !lower;
    }
    if (flip)
        for (i = 0; i <= work->sing_ind; i++) work->lam_star[i] = -work->lam_star[i];
}

static int qp_inconsistent_dual(const qp_work *work) {
    double dl = 0, tol = 0;
    int i;
    for (i = 0; i < work->n_active; i++) {
        const int id = work->WS[i];
        const double l = work->lam_star[i];
        if (QP_IS(work, id, QP_SOFT)) return 0;
        dl += l * (QP_IS(work, id, QP_LOWER) ? work->dlower[id] : work->dupper[id]);
        tol += fabs(l) * work->scaling[id];
    }
    return -dl > 2 * work->fval + QP_PRIMAL_TOL * tol;
}

static void qp_drop_singular_last(qp_work *work) {
    work->sense[work->WS[--work->n_active]] &= ~(QP_ACTIVE | QP_IMMUTABLE);
    work->sing_ind = QP_NONE;
    if (work->reuse_ind > work->n_active) work->reuse_ind = work->n_active;
}

static int qp_implied_last(qp_work *work) {
    int i;
    double residual = 0, scale = 1;
    qp_compute_singular_direction(work);
    for (i = 0; i <= work->sing_ind; i++) {
        const int id = work->WS[i], lower = QP_IS(work, id, QP_LOWER);
        const double term = work->lam_star[i] * (lower ? work->dlower[id] : work->dupper[id]);
        residual += term;
        scale += fabs(term);
        if (i < work->sing_ind && !QP_IS(work, id, QP_IMMUTABLE) &&
            (QP_IS(work, id, QP_SOFT) ||
             (lower ? -work->lam_star[i] : work->lam_star[i]) < -QP_ZERO_TOL))
            return 0;
    }
    return fabs(residual) <= QP_PRIMAL_TOL * scale;
}

static void qp_activate_one(qp_work *work, int id) {
    double lam = 1.0;
    const double w = QP_IS(work, id, QP_SOFT) ? qp_soft_w(work, id) : 0;
    if (w > 0) lam = QP_SLACK_FREE(work, id) ? w + 1 : 0.9 * w;
    qp_add(work, id, QP_IS(work, id, QP_LOWER) ? -lam : lam);
}

/* Build the working set from the marks in `sense`. */
static int qp_activate(qp_work *work) {
    int i, j, first_mutable = work->m, flag = 1;
    for (i = 0; i < work->m; i++) {
        if (!QP_IS(work, i, QP_ACTIVE)) continue;
        if (!QP_IS(work, i, QP_IMMUTABLE)) {
            if (i < first_mutable) first_mutable = i;
            continue;
        }
        qp_activate_one(work, i);
        if (work->sing_ind != QP_NONE) {
            const int implied = qp_implied_last(work);
            qp_drop_singular_last(work);
            if (!implied) flag = QP_OVERDETERMINED;
        }
    }
    for (i = first_mutable; i < work->m; i++) {
        if (!QP_IS(work, i, QP_ACTIVE) || QP_IS(work, i, QP_IMMUTABLE)) continue;
        qp_activate_one(work, i);
        if (work->sing_ind != QP_NONE) {
            qp_drop_singular_last(work);
            for (j = i + 1; j < work->m; j++)
                if (!QP_IS(work, j, QP_IMMUTABLE)) work->sense[j] &= ~QP_ACTIVE;
            return flag;
        }
    }
    return flag;
}

/* One step of iterative refinement on the active constraints. */
static void qp_refine_active(qp_work *work) {
    int i;
    work->reuse_ind = 0;
    for (i = 0; i < work->n_active; i++) {
        const int id = work->WS[i];
        work->xldl[i] = qp_row_dot(work, id, work->u) -
                        (QP_IS(work, id, QP_LOWER) ? work->dlower[id] : work->dupper[id]);
        if (QP_IS(work, id, QP_SOFT) && QP_SLACK_FREE(work, id))
            work->xldl[i] -= qp_soft_residual(work, id, work->lam_star[i]);
    }
    qp_solve_working_set(work);
    for (i = 0; i < work->n_active; i++) work->lam_star[i] += work->xldl[i];
    qp_sub_rows(work, work->xldl, work->u);
    qp_compute_fval(work);
}

static int qp_iterate(qp_work *work) {
    int flag = QP_ITERATION_LIMIT, iter, i, added;
    int repaired = 0, cycles = 0, refine_adds = 0, direction_ready = 0;
    double best_fval = -1;
    work->noise_floor = 0;
    for (iter = 1; iter < work->iteration_limit; ++iter) {
        int guard = 1;
        if (work->sing_ind != QP_NONE) {
            if (!direction_ready) qp_compute_singular_direction(work);
            direction_ready = 0;
            if (!qp_remove_blocking(work)) {
                flag = QP_INFEASIBLE;
                break;
            }
            continue;
        }
        direction_ready = 0;
        qp_compute_multipliers(work);
        if (qp_remove_blocking(work)) continue;
        qp_compute_primal(work);
        if (work->fval > 2 * QP_INF) {
            flag = QP_INFEASIBLE;
            break;
        }
        added = qp_add_infeasible(work);
        if (added && work->sing_ind != QP_NONE) {
            if (qp_implied_last(work)) {
                qp_drop_singular_last(work);
                for (i = 0; i < work->n_active; i++) work->lam_star[i] = work->lam[i];
                qp_refine_active(work);
                added = qp_add_infeasible(work);
            } else direction_ready = 1;
        }
        if (!added) {
            double min_D = work->D[0];
            for (i = 1; i < work->n_active; i++)
                if (work->D[i] < min_D) min_D = work->D[i];
            if (work->n_active > 2 && repaired != 1 && min_D < QP_REFACTOR_TOL) {
                repaired = 1;
                for (i = 0; i < work->n_active; i++) {
                    if (work->lam[i] >= 0) work->sense[work->WS[i]] &= ~QP_LOWER;
                    else work->sense[work->WS[i]] |= QP_LOWER;
                }
                qp_reset(work);
                qp_activate(work);
                continue;
            }
            guard = 0;
            if (work->n_active > 0 && min_D < QP_REFINE_PIVOT && refine_adds < 2) {
                qp_refine_active(work);
                if (qp_add_infeasible(work)) {
                    refine_adds++;
                    guard = 1;
                }
            }
            if (!guard) {
                if (qp_inconsistent_dual(work)) flag = QP_INFEASIBLE;
                else flag = qp_largest_slack(work) > QP_PRIMAL_TOL ? QP_SOFT_OPTIMAL : QP_OPTIMAL;
                break;
            }
        }
        if (work->fval - best_fval < QP_PROGRESS_TOL) {
            if (cycles++ > QP_CYCLE_TOL) {
                if (repaired == 1) {
                    if (work->noise_floor) {
                        flag = QP_CYCLE;
                        break;
                    }
                    work->noise_floor = 1;
                } else {
                    repaired = 1;
                    qp_reset(work);
                    qp_activate(work);
                }
                cycles = 0;
                best_fval = -1;
            }
        } else {
            best_fval = work->fval;
            cycles = 0;
            refine_adds = 0;
        }
    }
    work->iterations = iter;
    return flag;
}

/* -- from the program to its least-distance form --------------------------------------------- */

/* Packed inverse of the upper Cholesky factor of H. */
static int qp_factorise(qp_work *work) {
    int i, j, k, disp, other;
    const int n = work->n;
    double *R = work->Rinv, min_pivot = QP_INF, max_pivot = 0, inverse_max = 0, h_max = 0;
    for (i = 0, disp = 0; i < n; i++)
        for (j = i; j < n; j++) R[disp++] = work->H[j * n + i];
    for (i = 0, disp = 0; i < n; disp += n - i, i++) {
        double *row = R + disp, inverse;
        for (k = 0, other = i; k < i; k++, other += n - k) {
            const double *above = R + other, factor = R[other];
            for (j = 0; j < n - i; j++) row[j] -= factor * above[j];
        }
        if (!(row[0] > QP_ZERO_TOL)) return QP_NONCONVEX;
        if (row[0] < min_pivot) min_pivot = row[0];
        if (row[0] > max_pivot) max_pivot = row[0];
        inverse = 1 / sqrt(row[0]);
        for (j = 1; j < n - i; j++) row[j] *= inverse;
        row[0] = inverse;
    }
    if (!(min_pivot > QP_ZERO_TOL * max_pivot)) return QP_NONCONVEX;
    for (k = 0, disp = 0; k < n; k++) {
        double *row = R + disp, *below = R + disp + n - k;
        for (j = 1; j < n - k; j++) row[j] *= -row[0];
        for (i = 1; i < n - k; i++) {
            const double factor = row[i] *= below[0];
            for (j = 1; j < n - k - i; j++) row[i + j] -= below[j] * factor;
            below += n - k - i;
        }
        disp += n - k;
    }
    for (i = 0, disp = 0; i < n; i++) {
        double s2 = 0;
        for (j = i; j < n; j++, disp++) s2 += R[disp] * R[disp];
        if (s2 > inverse_max) inverse_max = s2;
        if (work->H[i * n + i] > h_max) h_max = work->H[i * n + i];
    }
    if (!(n * DBL_EPSILON * inverse_max * h_max <= QP_COND_EPS)) return QP_NONCONVEX;
    work->ill_conditioned = inverse_max * h_max > QP_REFINE_COND;
    return 0;
}

static int qp_zero_row_infeasible(const qp_work *work, int i) {
    const int s = QP_ZERO_ROW_SENSE(work->sense[i]);
    if (work->upper[i] - work->lower[i] < -QP_PRIMAL_TOL && !(s & QP_IMMUTABLE)) return 1;
    return (work->upper[i] < -QP_ZERO_TOL || work->lower[i] > QP_ZERO_TOL) &&
           (s & (QP_IMMUTABLE | QP_ACTIVE)) != QP_IMMUTABLE && !(s & QP_SOFT);
}

static int qp_check_bounds(qp_work *work) {
    int i;
    for (i = 0; i < work->m; i++) {
        double width;
        if (QP_IS(work, i, QP_IMMUTABLE) && !QP_IS(work, i, QP_AUTO_EQUALITY)) continue;
        width = work->upper[i] - work->lower[i];
        if (width < -QP_PRIMAL_TOL) return QP_INFEASIBLE;
        if (width < QP_ZERO_TOL && !QP_IS(work, i, QP_SOFT))
            work->sense[i] |= QP_ACTIVE | QP_IMMUTABLE | QP_AUTO_EQUALITY;
        else if (QP_IS(work, i, QP_AUTO_EQUALITY))
            work->sense[i] &= ~(QP_ACTIVE | QP_IMMUTABLE | QP_AUTO_EQUALITY);
    }
    return 0;
}

/* M = A R^-1, its rows of length one. */
static int qp_form_rows(qp_work *work) {
    int i, j, k;
    const int n = work->n;
    for (i = work->ms; i < work->m; i++) {
        const double *a = work->A + (i - work->ms) * n, *row = work->Rinv;
        double *m = work->M + (i - work->ms) * n, s2 = 0;
        for (j = 0; j < n; j++) m[j] = 0;
        for (k = 0; k < n; k++) {
            const double factor = a[k];
            for (j = k; j < n; j++) m[j] += factor * row[j - k];
            row += n - k;
        }
        for (j = 0; j < n; j++) s2 += m[j] * m[j];
        if (s2 < QP_ZERO_TOL) {
            int s = QP_ZERO_ROW_SENSE(work->sense[i]);
            work->scaling[i] = 1.0;
            if (qp_zero_row_infeasible(work, i)) return QP_INFEASIBLE;
            if (s & QP_AUTO_EQUALITY) s &= ~(QP_ACTIVE | QP_IMMUTABLE);
            work->sense[i] = QP_ZERO_ROW_MARK(s);
            continue;
        }
        s2 = 1 / sqrt(s2);
        work->scaling[i] = s2;
        for (j = 0; j < n; j++) m[j] *= s2;
    }
    return 0;
}

static int qp_form(qp_work *work) {
    int i, j, disp, flag;
    const int n = work->n;
    for (i = work->ms; i < work->m; i++) work->sense[i] = QP_ZERO_ROW_SENSE(work->sense[i]);
    if ((flag = qp_check_bounds(work)) < 0 || (flag = qp_factorise(work)) < 0) return flag;
    /* v = R^-T f */
    for (i = 0; i < n; i++) work->v[i] = 0;
    for (j = 0, disp = 0; j < n; j++)
        for (i = j; i < n; i++) work->v[i] += work->Rinv[disp++] * work->f[j];
    if ((flag = qp_form_rows(work)) < 0) return flag;
    for (i = 0, disp = 0; i < work->ms; i++) {
        double s2 = 0;
        for (j = i; j < n; j++) s2 += work->Rinv[disp + j - i] * work->Rinv[disp + j - i];
        s2 = 1 / sqrt(s2);
        work->scaling[i] = s2;
        for (j = i; j < n; j++) work->Rinv[disp++] *= s2;
    }
    for (i = 0; i < work->m; i++) {
        const double shift = qp_row_dot(work, i, work->v);
        work->dupper[i] = work->upper[i] * work->scaling[i] + shift;
        work->dlower[i] = work->lower[i] * work->scaling[i] + shift;
    }
    qp_reset(work);
    flag = qp_activate(work);
    return flag < 0 ? flag : 0;
}

/* y <-- R^-1 y; the rows of R^-1 of the bounds are of length one */
static void qp_apply_Rinv(const qp_work *work, double *y) {
    int i, disp;
    for (i = 0, disp = 0; i < work->n; i++) {
        y[i] = qp_dot(work->Rinv + disp, y + i, work->n - i);
        disp += work->n - i;
    }
    for (i = 0; i < work->ms; i++) y[i] /= work->scaling[i];
}

static double qp_value(const qp_work *work, int id) {
    return id < work->ms ? work->x[id]
                         : qp_dot(work->A + (id - work->ms) * work->n, work->x, work->n);
}

/* One step of iterative refinement of x on the active constraints. */
static void qp_refine_primal(qp_work *work) {
    int i, j;
    const int n = work->n, na = work->n_active;
    double *du = work->zldl;
    if (na == 0 || work->sing_ind != QP_NONE) return;
    if (!work->ill_conditioned) {
        double scale2 = work->fval, min_D = 1, err = QP_REFINE_GAIN * DBL_EPSILON;
        for (i = 0; i < na; i++)
            if (work->D[i] < min_D) min_D = work->D[i];
        for (i = 0; i < n; i++)
            if (work->v[i] * work->v[i] > scale2) scale2 = work->v[i] * work->v[i];
        if (err * err * scale2 <= QP_PRIMAL_TOL * QP_PRIMAL_TOL * min_D * min_D) return;
    }
    for (i = 0; i < na; i++)
        if (QP_IS(work, work->WS[i], QP_SOFT)) return;
    work->reuse_ind = 0;
    for (i = 0; i < na; i++) {
        const int id = work->WS[i];
        work->xldl[i] = (qp_value(work, id) -
                         (QP_IS(work, id, QP_LOWER) ? work->lower[id] : work->upper[id])) *
                        work->scaling[id];
    }
    qp_solve_working_set(work);
    for (j = 0; j < n; j++) du[j] = 0;
    qp_sub_rows(work, work->xldl, du);
    qp_apply_Rinv(work, du);
    for (i = 0; i < n; i++) work->x[i] += du[i];
}

static int qp_violates_hard(const qp_work *work) {
    int i;
    for (i = 0; i < work->m; i++) {
        double value;
        if (QP_IS(work, i, QP_SOFT) ||
            (QP_IS(work, i, QP_IMMUTABLE) && !QP_IS(work, i, QP_ACTIVE)))
            continue;
        value = qp_value(work, i);
        if (value > work->upper[i] + QP_PRIMAL_TOL || value < work->lower[i] - QP_PRIMAL_TOL)
            return 1;
    }
    return 0;
}

/* Solve; x is the answer where the result is QP_OPTIMAL or QP_SOFT_OPTIMAL. */
static int qp_solve(qp_work *work) {
    int i, flag;
    work->iterations = 0;
    if ((flag = qp_form(work)) < 0) return flag;
    flag = qp_iterate(work);
    if (flag <= 0) return flag;
    for (i = 0; i < work->n; i++) work->x[i] = work->u[i] - work->v[i];
    qp_apply_Rinv(work, work->x);
    for (i = 0; i < work->n_active; i++) work->lam_star[i] *= work->scaling[work->WS[i]];
    qp_refine_primal(work);
    if (work->noise_floor && qp_violates_hard(work)) flag = QP_INEXACT;
    for (i = 0; i < work->n; i++)
        if (!isfinite(work->x[i])) return QP_NONCONVEX;
    return flag;
}
