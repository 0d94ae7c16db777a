/* MPC_TITLE
 *
 * One controller a context: the functions share nothing but constants, so that several contexts
 * may run in several threads. Nothing is allocated, nothing calls itself. Signals and units stand
 * in README.md.
 */
#ifndef MPC_H
#define MPC_H

#ifdef __cplusplus
extern "C" {
#endif

MPC_DEFINITIONS
/* An array in C has one element at least. */
#define MPC_ROOM(n) ((n) > 0 ? (n) : 1)

/* How a step ended. */
typedef enum {
    MPC_OK = 0,      /* solved */
    MPC_BUDGET = 1,  /* stopped at the iteration budget before convergence */
    MPC_RELAXED = 2, /* the terminal constraint could not be met and was relaxed */
    MPC_FAILED = 3   /* the solve failed; the fall-back acted */
} mpc_status;

/* What acted in a failed step. */
typedef enum {
    MPC_NO_FALLBACK = 0,
    MPC_SHIFTED_PLAN = 1, /* the last plan, one period on */
    MPC_HOLD = 2,         /* the last command */
    MPC_STEADY_INPUT = 3  /* the input of the steady state of the reference */
} mpc_fallback;

typedef struct {
    mpc_status status;
    mpc_fallback fallback;
    int iterations;           /* of Newton */
    int qp_iterations;        /* changes of the active set, all QPs of the step */
    int steady_iterations;    /* of the search for the steady state */
    int target_projected;     /* 1: the reference is out of reach, the nearest is the target */
    int target_held;          /* 0: no input holds the torques; the last target goes on */
    double objective;         /* J of the plan */
    double merit;             /* J with the penalties */
    double violation;         /* largest violation of a soft limit, the state's unit */
    double terminal_residual; /* largest, as a share of the states' typical sizes */
    double kkt_residual;      /* largest component of the gradient before the last iteration */
} mpc_info;

/* What may be changed between two steps; mpc_init fills in the exported values. */
typedef struct {
MPC_SETTINGS_FIELDS
} mpc_settings;

/* A steady state; see steady-state part of the source. */
typedef struct {
    double x[MPC_N_X], u[MPC_N_U], reached[MPC_N_R], asked[MPC_N_R], multiplier[MPC_N_S];
    double residual;
    int active[MPC_N_U];
    int projected, converged;
} mpc_target;

typedef struct {
    double z[2 * MPC_N_S + MPC_N_U], z_next[2 * MPC_N_S + MPC_N_U];
    double r[MPC_N_R], w[MPC_ROOM(MPC_N_W)], active[MPC_N_U], bound[MPC_N_U], curved;
    double report[2 + MPC_N_U], x[MPC_N_X];
    double rest[MPC_N_S];                    /* the model at rest, its memories as they are */
} mpc_steady;

/* Everything that lasts from step to step comes first; the rest is scratch. */
typedef struct {
    mpc_settings settings;
    int first;                               /* 1 before the first step */
    int has_target, solved_for_valid, target_is_held;
    double plan[MPC_N_Z];                    /* inputs, block after block, V */
    double full[MPC_N_FULL];                 /* state, then what is remembered of past commands */
    double last_u[MPC_N_U];
    mpc_target target;
    double solved_for[MPC_N_R + MPC_N_W + MPC_N_PATHS];
    double last_reference[MPC_N_R], moves[MPC_N_R][6]; /* what forecasts are made of */
    int n_moves[MPC_N_R], reference_seen;
    int sense[MPC_N_Z + MPC_ROWS];           /* active sets of the last QPs: without */
    int sense_limited[MPC_N_Z + MPC_ROOM(MPC_ROWS_LIMITED)]; /* and with soft limits */

    mpc_steady steady;
    int steady_iterations, qp_iterations;
    double start[MPC_N_U], w[MPC_ROOM(MPC_N_W)], reference[MPC_N * MPC_N_R];
    double rates[MPC_N * MPC_N_R];
    double ahead[(MPC_FORECAST + 1) * MPC_N_R];
    double plan_kept[MPC_N_Z], trial[MPC_N_Z];
    double trajectory[MPC_N * MPC_N_FULL];
    double sensitivity[2][MPC_N_FULL * MPC_N_Z];
    double stage_next[MPC_N_FULL], stage_a[MPC_N_FULL * MPC_N_FULL], stage_b[MPC_N_FULL * MPC_N_U];
    double hessian[MPC_N_Z * MPC_N_Z], gradient[MPC_N_Z];
    double errors[MPC_ROOM(MPC_N_WEIGHTED + MPC_N_DAMPED) * MPC_N_Z];
    double damped_before[MPC_ROOM(MPC_N_DAMPED) * MPC_N_Z];
    double rows[MPC_ROOM(MPC_ROWS + MPC_ROWS_SOFT) * MPC_N_Z];
    double qp_lower[MPC_N_Z + MPC_ROWS + MPC_ROWS_SOFT];
    double qp_upper[MPC_N_Z + MPC_ROWS + MPC_ROWS_SOFT];
    double qp_rho[MPC_N_Z + MPC_ROWS + MPC_ROWS_SOFT], qp_w[MPC_N_Z + MPC_ROWS + MPC_ROWS_SOFT];
    double qp_scaling[MPC_N_Z + MPC_ROWS + MPC_ROWS_SOFT];
    double qp_dupper[MPC_N_Z + MPC_ROWS + MPC_ROWS_SOFT];
    double qp_dlower[MPC_N_Z + MPC_ROWS + MPC_ROWS_SOFT];
    double qp_m[MPC_ROOM(MPC_ROWS + MPC_ROWS_SOFT) * MPC_N_Z];
    double qp_rinv[MPC_N_Z * (MPC_N_Z + 1) / 2];
    double qp_v[MPC_N_Z], qp_x[MPC_N_Z], qp_u[MPC_N_Z], curvature[MPC_N_Z];
    double qp_lam[MPC_QP_ACTIVE], qp_lam_star[MPC_QP_ACTIVE], qp_d[MPC_QP_ACTIVE];
    double qp_xldl[MPC_QP_ACTIVE], qp_zldl[MPC_QP_ACTIVE], qp_waiting_lam[MPC_QP_ACTIVE];
    double qp_l[MPC_QP_ACTIVE * (MPC_QP_ACTIVE + 1) / 2];
    int qp_ws[MPC_QP_ACTIVE], qp_waiting[MPC_QP_ACTIVE];
    double work[MPC_ROOM(MPC_SZ_W)];
    long long int iw[MPC_ROOM(MPC_SZ_IW)];
} mpc_ctx;

/* A fresh controller: the exported settings, the rig at rest, the input path as after a long time
 * without a command. */
void mpc_init(mpc_ctx *ctx);

/* The same, with the command that has been in force for a long time, V. */
void mpc_init_at(mpc_ctx *ctx, const double *u_first);

/* The command from now to the next control period; returns info->status.
 *
 * x_hat       (MPC_N_X) estimated state of the model.
 * w_hat       (MPC_N_W) estimated constant torques on its equations; NULL: none.
 * reference   (MPC_N_R x (MPC_PREVIEW + 1)) of the controlled signals now and at the next
 *             control periods: reference[k * MPC_N_R + i] is signal i, k periods ahead.
 * u_previous  (MPC_N_U) the command as it was applied over the last period, V.
 * u           (MPC_N_U) result, V: always finite and within the limits.
 * info        what happened; NULL if not wanted.
 */
mpc_status mpc_step(mpc_ctx *ctx, const double *x_hat, const double *w_hat,
                    const double *reference, const double *u_previous, double *u,
                    mpc_info *info);

MPC_OBSERVER_DECLARATIONS
#ifdef __cplusplus
}
#endif

#endif
