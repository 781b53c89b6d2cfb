/* A model (MODEL: a file with `start` and `compute`) as an FMU of FMI 2.0 or 3.0 for co-simulation. Variables are
   numbers whose value references are their places in `v`. The headers are those that come with FMPy. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef struct { double v[8], before, time; } Model;
static int starts; /* instances of this process so far */
#include MODEL

#if FMI == 3
#include "fmi3Functions.h"
#define F(name) fmi3##name
#define STATE(before, after) fmi3##before##FMUState##after
#define READ fmi3DeserializeFMUState
typedef fmi3Status Status;
typedef fmi3Instance Unit;
typedef fmi3ValueReference Place;
typedef fmi3FMUState State;
typedef fmi3Byte Byte;
#else
#include "fmi2Functions.h"
#define F(name) fmi2##name
#define STATE(before, after) fmi2##before##FMUstate##after
#define READ fmi2DeSerializeFMUstate
typedef fmi2Status Status;
typedef fmi2Component Unit;
typedef fmi2ValueReference Place;
typedef fmi2FMUstate State;
typedef fmi2Byte Byte;
#endif

static Unit created(void) {
    Model *m = calloc(1, sizeof(Model));
    start(m->v);
    starts++;
    return m;
}

static Status take(Unit c, const Place r[], size_t n, const double x[]) {
    for (size_t k = 0; k < n; k++) ((Model *)c)->v[r[k]] = x[k];
    return 0;
}

static Status give(Unit c, const Place r[], size_t n, double x[]) {
    for (size_t k = 0; k < n; k++) x[k] = ((Model *)c)->v[r[k]];
    return 0;
}

static Status go(Unit c, double t, double h) {
    Model *m = c;
    if (fabs(t - m->time) > 1e-9) return 3;
    m->time = t + h;
    return compute(m, h);
}

void F(FreeInstance)(Unit c) { free(c); }

Status STATE(Get, )(Unit c, State *s) {
    *s = malloc(sizeof(Model));
    memcpy(*s, c, sizeof(Model));
    return 0;
}

Status STATE(Set, )(Unit c, State s) {
    memcpy(c, s, sizeof(Model));
    return 0;
}

Status STATE(Free, )(Unit c, State *s) {
    free(*s);
    *s = 0;
    return 0;
}

Status STATE(Serialized, Size)(Unit c, State s, size_t *n) {
    *n = sizeof(Model);
    return 0;
}

Status STATE(Serialize, )(Unit c, State s, Byte b[], size_t n) {
    memcpy(b, s, n);
    return 0;
}

Status READ(Unit c, const Byte b[], size_t n, State *s) {
    *s = malloc(n);
    memcpy(*s, b, n);
    return 0;
}

#if FMI == 3
Unit fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean events,
    fmi3Boolean early, const Place r[], size_t n, fmi3InstanceEnvironment whose, fmi3LogMessageCallback log,
    fmi3IntermediateUpdateCallback update) {
    return created();
}

Status fmi3SetFloat64(Unit c, const Place r[], size_t n, const double x[], size_t m) { return take(c, r, n, x); }

Status fmi3GetFloat64(Unit c, const Place r[], size_t n, double x[], size_t m) { return give(c, r, n, x); }

Status fmi3DoStep(
    Unit c, double t, double h, fmi3Boolean whether, fmi3Boolean *event, fmi3Boolean *end, fmi3Boolean *early,
    double *reached) {
    *event = *early = 0;
    *end = t >= END;
    *reached = t + h;
    return go(c, t, h);
}
#else
Unit fmi2Instantiate(
    fmi2String name, fmi2Type type, fmi2String token, fmi2String resources, const fmi2CallbackFunctions *f,
    fmi2Boolean visible, fmi2Boolean logging) {
    return created();
}

Status fmi2SetReal(Unit c, const Place r[], size_t n, const double x[]) { return take(c, r, n, x); }

Status fmi2GetReal(Unit c, const Place r[], size_t n, double x[]) { return give(c, r, n, x); }

Status fmi2DoStep(Unit c, double t, double h, fmi2Boolean whether) { return go(c, t, h); }
#endif
