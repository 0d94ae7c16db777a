/* The same of an exported observer: sizes, the struct's bytes, its period (s); zero without one. */
void mpc_drive_observer(int *sizes, size_t *bytes, double *period) {
#ifdef MPC_OBSERVER_PERIOD
    sizes[0] = MPC_N_Y;
    sizes[1] = MPC_N_Z_HAT;
    bytes[0] = sizeof(mpc_observer);
    period[0] = MPC_OBSERVER_PERIOD;
#else
    sizes[0] = sizes[1] = 0;
    bytes[0] = 0;
    period[0] = 0;
#endif
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
