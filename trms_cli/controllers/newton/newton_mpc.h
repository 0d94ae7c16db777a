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
    MPC_BUDGET = 1,  /* stopped at the iteration budget, of Newton or of a QP, before convergence */
    MPC_RELAXED = 2, /* the terminal constraint could not be met and was relaxed */
    MPC_FAILED = 3   /* the solve failed; the fall-back acted */
} mpc_status;

/* What acted in a failed step. */
typedef enum {
    MPC_NO_FALLBACK = 0,
    MPC_SHIFTED_PLAN = 1, /* the last plan, one period on */
    MPC_HOLD = 2,         /* the last command */
    MPC_STEADY_INPUT = 3, /* the input of the steady state of the reference */
    MPC_STOP = 4          /* the last command, and the run is to end: bring the rig to rest */
} mpc_fallback;

/* Why a step failed. */
typedef enum {
    MPC_NO_REASON = 0,
    MPC_NOT_FINITE = 1,       /* an estimate, a reference or a command is no number */
    MPC_DIVERGED = 2,         /* the predicted trajectory is not finite */
    MPC_PROGRAM_UNSOLVED = 3  /* the quadratic program has no solution */
} mpc_reason;

typedef struct {
    mpc_status status;
    mpc_fallback fallback;
    mpc_reason reason;
    int iterations;           /* of Newton */
    int qp_iterations;        /* recursions over the horizon, all QPs of the step */
    int capped;               /* 1: the last QP ended at its most recursions, near its solution */
    int steady_iterations;    /* of the search for the steady state */
    int target_projected;     /* 1: the reference is out of reach, the nearest is the target */
    int target_has_no_region; /* 1: its steady state ends the horizon in place of a region */
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

#define MPC_END_COST (MPC_REGION || MPC_LINEAR)

#if MPC_END_COST
/* Cost |root xi|^2 of where the horizon ends, of xi = (state, last input) - centre. In a region
 * besides |root xi| <= radius, and beyond its end u = u_s + gain xi. */
typedef struct {
    int holds; /* 0: this target has none, its steady state ends the horizon */
    double centre[MPC_N_V], root[MPC_N_V][MPC_N_V], gain[MPC_N_U][MPC_N_V], radius;
} mpc_region;
#endif

#if MPC_LINEAR
/* Next state: F (state, input) + drift. */
typedef struct {
    double F[MPC_N_FULL][MPC_N_F], drift[MPC_N_FULL];
} mpc_linear;
#endif

#if MPC_REGION

/* A region that was designed, by the cell that its target lies in. */
typedef struct {
    double cell[MPC_N_X + MPC_N_U];
    mpc_region region;
} mpc_known_region;

#define MPC_REGIONS 16      /* that are remembered */
#define MPC_REGION_WORST 16 /* directions that are looked around */
#define MPC_REGION_DIRECTIONS 512

typedef struct {
    double worst[MPC_REGION_WORST][MPC_N_V], gaps[MPC_REGION_DIRECTIONS];
} mpc_region_search;
#endif

/* A constraint of the quadratic program's interior point: room to it, price, where both go. */
typedef struct {
    double room, price, d_room, d_price;
} mpc_pair;

/* Work of the quadratic program. A value function is q'M q / 2 of q = (state, last input,
 * 1, multipliers of the terminal constraint and of soft limits), without the row of 1. By block and input: slope of
 * the cost, and gains, by q and the block's inputs. */
typedef struct {
    double F[MPC_N][MPC_N_FULL][MPC_N_F]; /* next state by (state, input) */
    double value[MPC_N + 1][MPC_N_V + MPC_N_PRICES][MPC_N_M];
    double slope[MPC_N_BLOCKS][MPC_N_U][MPC_N_ROW], gain[MPC_N_BLOCKS][MPC_N_U][MPC_N_ROW];
    double miss[MPC_ROOM(MPC_N_TERMINAL)], price[MPC_ROOM(MPC_N_PRICES)];
    double dz[MPC_N_Z], dx[MPC_N + 1][MPC_N_FULL], dx_before[MPC_N + 1][MPC_N_FULL];
    signed char side[MPC_N_Z], turn[MPC_N_Z], order[MPC_N_BLOCKS][MPC_N_U];
    signed char touch[MPC_ROOM(MPC_ROWS_SOFT)], touch_turn[MPC_ROOM(MPC_ROWS_SOFT)];
    double touch_price[MPC_ROOM(MPC_ROWS_SOFT)];
    int on[MPC_ROOM(MPC_ROWS_SOFT)]; /* multiplier of a limit that is touched */
#if MPC_RATES_LIMITED
    signed char fast[MPC_N_Z], fast_turn[MPC_N_Z]; /* at its limit of rate besides its bound */
    int on_rate[MPC_N_Z];
#endif
    int is_interior, has_limits, is_capped, n_on, width;
    mpc_pair pair[MPC_QP_PAIRS];
    double inside[MPC_N_Z], bound_weight[MPC_N_Z], bound_slope[MPC_N_Z];
    double rate_weight[MPC_N_Z], rate_slope[MPC_N_Z];
    double soft_weight[MPC_ROOM(MPC_ROWS_SOFT)], soft_slope[MPC_ROOM(MPC_ROWS_SOFT)];
} mpc_qp;


/* Everything that lasts from step to step comes first; the rest is scratch. */
typedef struct {
    mpc_settings settings;
    int first;                               /* 1 before the first step */
    int has_target, solved_for_valid, target_is_held;
    double plan[MPC_N_Z];                    /* inputs, block after block, V */
    double full[MPC_N_FULL];                 /* state, then what is remembered of past commands */
    double last_u[MPC_N_U];
    double remaining_share;                  /* that a full Newton step leaves to go */
    mpc_target target;
    double linearise_seconds, qp_seconds;    /* of the last step, where there is a clock */
    double solved_for[MPC_N_R + MPC_N_W + MPC_N_PATHS];
    double last_reference[MPC_N_R], moves[MPC_N_R][6]; /* what forecasts are made of */
    int n_moves[MPC_N_R], reference_seen;
#if MPC_LINEAR
    mpc_linear model;
    double model_input[MPC_N_U]; /* of the target that it was taken at */
    int has_model;
#endif
#if MPC_END_COST
    mpc_region region;
#endif
#if MPC_REGION
    mpc_known_region regions[MPC_REGIONS];
    int n_regions, next_region;
    mpc_region_search region_search;
#endif

    mpc_steady steady;
    int steady_iterations, qp_iterations;
    double start[MPC_N_U], w[MPC_ROOM(MPC_N_W)], reference[MPC_N * MPC_N_R];
    double rates[MPC_N * MPC_N_R];
    double ahead[(MPC_FORECAST + 1) * MPC_N_R];
    double plan_kept[MPC_N_Z], trial[MPC_N_Z];
    double trajectory[MPC_N * MPC_N_FULL];
    double stage_next[MPC_N_FULL];
    mpc_qp qp;
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
