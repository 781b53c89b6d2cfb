/* An output that differs from instance to instance. 1: input, 2: output */
static void start(double *v) { v[3] = 1e-9 * starts; }

static int compute(Model *m, double h) {
    m->v[2] = m->v[1] + m->v[3];
    return 0;
}
