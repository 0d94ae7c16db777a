/* What a program asks of an exported controller, and of its observer, that drives a rig with them:
 * sizes, and what stands in their structs, as plain arrays. */
#include "mpc_source.c"

#include <stddef.h>

/* Sizes that a rig's signals have to fit. */
void mpc_drive_sizes(int *sizes) {
    sizes[0] = MPC_N_X;
    sizes[1] = MPC_N_U;
    sizes[2] = MPC_N_W;
    sizes[3] = MPC_N_R;
    sizes[4] = MPC_PREVIEW;
#ifdef MPC_OBSERVER_PERIOD
    sizes[5] = MPC_N_Y;
    sizes[6] = MPC_N_Z_HAT;
#else
    sizes[5] = sizes[6] = 0;
#endif
}

/* Of the structs, in bytes; and their periods, s. Zero without an observer. */
void mpc_drive_structs(size_t *bytes, double *periods) {
    bytes[0] = sizeof(mpc_ctx);
    periods[0] = MPC_PERIOD;
#ifdef MPC_OBSERVER_PERIOD
    bytes[1] = sizeof(mpc_observer);
    periods[1] = MPC_OBSERVER_PERIOD;
#else
    bytes[1] = 0;
    periods[1] = 0;
#endif
}

/* A step, and what it says of itself in numbers. */
int mpc_drive_step(mpc_ctx *c, const double *x_hat, const double *w_hat, const double *reference,
                   const double *u_previous, double *u, double *words) {
    mpc_info info;
    const int status = mpc_step(c, x_hat, w_hat, reference, u_previous, u, &info);
    words[0] = info.fallback;
    words[1] = info.iterations;
    words[2] = info.objective;
    words[3] = info.violation;
    words[4] = info.terminal_residual;
    words[5] = info.kkt_residual;
    words[6] = info.target_projected;
    words[7] = info.target_held;
    return status;
}

#ifdef MPC_OBSERVER_PERIOD
static double *mpc_drive_put(double *to, const double *from, int count) {
    int i;
    for (i = 0; i < count; i++) to[i] = from[i];
    return to + count;
}

/* A sample of the observer, and what it believes besides. known: measured torques; NULL: none. */
void mpc_drive_observe(mpc_observer *o, const double *u, const double *y, const double *known,
                       double *x_hat, double *w_hat, double *words) {
    int i;
    for (i = 0; known != NULL && i < MPC_N_W; i++) o->known[i] = known[i];
    mpc_observe(o, u, y, NULL, x_hat, w_hat);
    words = mpc_drive_put(words, o->sd, MPC_N_Z_HAT);
    words = mpc_drive_put(words, o->disturbance_sd, MPC_N_W);
    words = mpc_drive_put(words, o->predicted, MPC_N_Y);
    words = mpc_drive_put(words, o->innovation, MPC_N_Y);
    words = mpc_drive_put(words, o->innovation_sd, MPC_N_Y);
    words = mpc_drive_put(words, o->rejected, MPC_N_Y);
    mpc_drive_put(words, o->mask, MPC_N_Y);
}
#endif
