/* -- observer -------------------------------------------------------------------------------- */

MPC_DEFINITIONS
/* Its state, and what it says of the last sample. */
typedef struct {
    double mean[MPC_N_Z_HAT], covariance[MPC_N_Z_HAT * MPC_N_Z_HAT];
    double memory[MPC_ROOM(MPC_N_MEMORY)];
    double prior_mean[MPC_N_Z_HAT], gate[MPC_N_Y];
    double p[MPC_ROOM(MPC_N_P_HAT)];     /* parameters of its step; may be changed */
    double known[MPC_ROOM(MPC_N_W)];     /* measured torques, N m; zero unless you set them */
    int run[MPC_N_Y], open[MPC_N_Y], counting, started;
    int recoveries;                      /* how often the covariance had to go back to the first */

    double sd[MPC_N_Z_HAT];              /* standard deviations of mean */
    double disturbance[MPC_ROOM(MPC_N_W)], disturbance_sd[MPC_ROOM(MPC_N_W)];
    double predicted[MPC_N_Y], innovation[MPC_N_Y], innovation_sd[MPC_N_Y];
    double rejected[MPC_N_Y];            /* 1 for a sample that was there and not believed */

    double u[MPC_N_U], y[MPC_N_Y], mask[MPC_N_Y], advance, health;
    double mean_next[MPC_N_Z_HAT], covariance_next[MPC_N_Z_HAT * MPC_N_Z_HAT];
    double memory_next[MPC_ROOM(MPC_N_MEMORY)];
    double work[MPC_ROOM(MPC_OBSERVER_SZ_W)];
    long long int iw[MPC_ROOM(MPC_OBSERVER_SZ_IW)];
} mpc_observer;

/* A fresh filter. y_first: the first measurement, NaN where missing (NULL: the rig at rest);
 * u_first: the command in force before, V (NULL: none). */
void mpc_observer_init(mpc_observer *observer, const double *y_first, const double *u_first);

/* One sample, every MPC_OBSERVER_PERIOD seconds.
 *
 * u      (MPC_N_U) what was applied since the last sample (at the first: u_first), V.
 * y      (MPC_N_Y) measurement, NaN where missing.
 * mask   (MPC_N_Y) 0 where a sample is missing or not to be used; NULL: all are there.
 * x_hat  (MPC_N_X), w_hat (MPC_N_W) result: what mpc_step takes; w_hat may be NULL.
 */
void mpc_observe(mpc_observer *observer, const double *u, const double *y, const int *mask,
                 double *x_hat, double *w_hat);

