/* A first-order filter that computes in steps of 1 ms if LIMITED. 1: input, 2: output, 3: rate [1/s] */
static void start(double *v) { v[3] = 2000.0; }

static int compute(Model *m, double h) {
    if (LIMITED && fabs(h - 1e-3) > 1e-12) return 3;
    m->v[2] += (1 - exp(-m->v[3] * h)) * (m->v[1] - m->v[2]);
    return 0;
}
