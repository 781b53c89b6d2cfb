// SPDX-License-Identifier: Apache-2.0
// The laws of the cells in plain C, one sample at a time: the arithmetic of lathe_rc in the same order.
//
// two_channel.c and full_cell.c make cells of them. benchmarks/plain_c.py fills the structures from the stages of a
// scenario, so that no parameter is written twice. What a cell of those two does not have is left out here: corrections,
// supervisors, faults, noise and resolution of sensors, limits of commands, backlash, keyways, regeneration.

#ifndef LATHE_LAWS_H
#define LATHE_LAWS_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#define TURN 6.283185307179586
#define MAX_LINES 4
#define MAX_PLAYS 16
#define MAX_ORDER 6

// Multiplied out where it is called: loops over an order that is known are no loops.
#define KNOWN static inline __attribute__((always_inline))

static inline double least(double a, double b)
{
    return b < a ? b : a;
}

static inline double greatest(double a, double b)
{
    return b > a ? b : a;
}

static inline double within(double value, double low, double high)
{
    return least(greatest(value, low), high);
}

static inline double quantised(double value, double resolution)
{
    return resolution > 0.0 ? rint(value / resolution) * resolution : value;
}

// ---- spindle and ideal encoder ---------------------------------------------------------------------------------------

typedef struct {
    int64_t count;
    double step, nominal, amplitude[MAX_LINES], frequency[MAX_LINES], phase[MAX_LINES], start[MAX_LINES];
    double cosine[MAX_LINES];  // of the phase
    // what changes
    double revolution;
} Spindle;

// Fill angle and speed of sample n; returns whether a revolution begins.
static inline int turn(Spindle *restrict s, int64_t n, double *angle, double *speed)
{
    const double t = (double)n * s->step;
    double turned = t, rate = 1.0;
    for (int64_t i = 0; i < s->count; i++) {
        const double since = t - s->start[i];
        if (since >= 0.0) {
            const double a = s->amplitude[i], w = s->frequency[i], place = w * since + s->phase[i];
            turned += a / w * (s->cosine[i] - cos(place));
            rate += a * sin(place);
        }
    }
    *angle = s->nominal * turned;
    *speed = s->nominal * rate;
    const double whole = floor(*angle / TURN), before = s->revolution;
    s->revolution = whole;
    return whole > before;
}

// ---- self-learning controller ----------------------------------------------------------------------------------------

typedef struct {
    int64_t grid, cycle, mask, reach, size, looks_ahead;
    double lead_time, constant, gain, ratio, join_below;
    double *memory, *scratch, *forward, *smoothed;
    // what changes
    int64_t point, base, learn_from, joined, seen, ahead;
    double angle[4], error[4], squares, largest;
} Channel;

static inline double cubic(double before, double left, double right, double after, double u)
{
    double c1 = right - before / 3.0 - left / 2.0 - after / 6.0;
    double c2 = (before + right) / 2.0 - left;
    double c3 = (after - before) / 6.0 + (left - right) / 2.0;
    return left + u * (c1 + u * (c2 + u * c3));
}

static void smooth(Channel *c)
{
    const int64_t size = c->size + 2 * c->reach, last = size - 1;
    const double ratio = c->ratio, gain = (1.0 - ratio) / (1.0 + ratio);
    double *points = c->scratch;
    for (int64_t k = 0; k < size; k++)
        points[k] = c->memory[(c->base - c->cycle - c->reach + k) & c->mask];
    double forward = 0.0, backward = 0.0;
    for (int64_t k = 0; k < size - c->reach; k++) {
        forward = ratio * forward + points[k];
        c->forward[last - k] = backward;
        backward = ratio * backward + points[last - k];
        if (k >= c->reach)
            c->smoothed[k - c->reach] = forward;
    }
    for (int64_t k = 0; k < c->size; k++)
        c->smoothed[k] = gain * (c->smoothed[k] + ratio * c->forward[k + c->reach]);
}

// The command at an angle; `arrived`: the error of an earlier sample has come, with its angle.
static inline double control(Channel *c, int arrived, double angle, double speed, double past_angle, double error)
{
    const double per_radian = (double)c->grid / TURN;
    if (arrived) {
        if (c->seen == 0) {
            for (int i = 0; i < 4; i++) {
                c->angle[i] = past_angle;
                c->error[i] = error;
            }
            c->point = (int64_t)ceil(past_angle * per_radian);
            c->learn_from = c->point > c->learn_from ? c->point : c->learn_from;
        }
        c->angle[0] = c->angle[1], c->angle[1] = c->angle[2], c->angle[2] = c->angle[3], c->angle[3] = past_angle;
        c->error[0] = c->error[1], c->error[1] = c->error[2], c->error[2] = c->error[3], c->error[3] = error;
        c->seen++;
        if (c->angle[2] > c->angle[1]) {
            const double per_angle = 1.0 / (c->angle[2] - c->angle[1]);
            for (double place; (place = c->point / per_radian) <= c->angle[2];) {
                double y = c->memory[(c->point - c->cycle) & c->mask];
                const double delta = cubic(
                    c->error[0], c->error[1], c->error[2], c->error[3], (place - c->angle[1]) * per_angle);
                if (c->joined) {
                    if (c->point < c->base || c->point - c->base >= c->size) {
                        c->base = c->point / c->size * c->size;
                        smooth(c);
                    }
                    y = c->smoothed[c->point - c->base];
                    if (c->point >= c->learn_from)
                        y += delta * c->gain;
                }
                c->memory[c->point & c->mask] = y;
                c->squares += delta * delta;
                c->largest = fabs(delta) > c->largest ? fabs(delta) : c->largest;
                c->point++;
                if (c->point % c->cycle == 0) {
                    if (!c->joined && c->largest <= c->join_below) {
                        c->joined = 1;
                        c->learn_from = c->point;
                    }
                    c->squares = c->largest = 0.0;
                }
            }
        }
    }
    const double place = (angle + (c->lead_time * speed + c->constant)) * per_radian - (double)c->cycle;
    const double left = floor(place);
    c->ahead += c->seen > 0 && left + c->looks_ahead >= c->point;
    const int64_t i = (int64_t)left;
    const double *m = c->memory;
    return cubic(m[(i - 1) & c->mask], m[i & c->mask], m[(i + 1) & c->mask], m[(i + 2) & c->mask], place - left);
}

// ---- coarse drive ----------------------------------------------------------------------------------------------------

typedef struct {
    double position, velocity, effort;
} Motion;

typedef struct {
    double transition[4], weights[6], part, spring, damper, force_per_current, stroke;
    // what changes
    double x, v;
    int64_t stopped;
} Coarse;

// The motion by commands that end at `u`, delayed by whole samples.
static inline Motion drive(Coarse *d, const double *u)
{
    const double *t = d->transition, *w = d->weights;
    const double x = t[0] * d->x + t[1] * d->v + w[0] * u[0] + w[1] * u[-1] + w[2] * u[-2];
    const double v = t[2] * d->x + t[3] * d->v + w[3] * u[0] + w[4] * u[-1] + w[5] * u[-2];
    d->x = x, d->v = v;
    if (x > d->stroke) {
        d->x = d->stroke, d->v = v < 0.0 ? v : 0.0;
        d->stopped++;
    } else if (x < -d->stroke) {
        d->x = -d->stroke, d->v = v > 0.0 ? v : 0.0;
        d->stopped++;
    }
    const double delayed = (1.0 - d->part) * u[0] + d->part * u[-1];
    return (Motion){d->x, d->v, (d->spring * (delayed - d->x) - d->damper * d->v) * d->force_per_current};
}

// ---- fine drive ------------------------------------------------------------------------------------------------------

typedef struct {
    int64_t count;
    double proportional, threshold[MAX_PLAYS], weight[MAX_PLAYS];
    // what changes
    double position[MAX_PLAYS];
} Plays;

typedef struct {
    double transition[4], weights[6], stroke, full_voltage, decay, now, before;
    Plays inverse, forward;
    // what changes
    double amplified, applied, extension, x, v;
    int64_t saturated;
} Fine;

static inline double hysteresis(Plays *p, double value)
{
    double result = p->proportional * value;
    for (int64_t i = 0; i < p->count; i++) {
        p->position[i] = within(p->position[i], value - p->threshold[i], value + p->threshold[i]);
        result += p->weight[i] * p->position[i];
    }
    return result;
}

static inline Motion extend(Fine *f, double set_point)
{
    const double wanted = set_point / f->stroke, inside = within(wanted, -1.0, 1.0);
    const double demand = hysteresis(&f->inverse, inside), applied = within(demand, -1.0, 1.0);
    f->saturated += wanted != inside || fabs(demand) > 1.0 + 1e-9;
    f->amplified = f->decay * f->amplified + f->now * applied + f->before * f->applied;
    f->applied = applied;
    const double extension = f->stroke * hysteresis(&f->forward, f->amplified), before = f->extension;
    const double *t = f->transition, *w = f->weights;
    const double x = t[0] * f->x + t[1] * f->v + w[0] * extension + w[1] * before;
    const double v = t[2] * f->x + t[3] * f->v + w[3] * extension + w[4] * before;
    f->x = x, f->v = v, f->extension = extension;
    return (Motion){x, v, f->amplified * f->full_voltage};
}

// ---- form of the part ------------------------------------------------------------------------------------------------

typedef struct {
    int64_t rows, points;
    double feed, start;
    const double *heights, *table;
    // what changes
    int64_t row;
} Form;

static inline double deviation(Form *f, double angle, double height)
{
    const double place = angle * ((double)f->points / TURN), whole = floor(place), u = place - whole;
    const int64_t j = (int64_t)whole & (f->points - 1);
    double v = 0.0;
    if (f->rows > 1) {
        while (f->row > 0 && !(height >= f->heights[f->row]))
            f->row--;
        while (f->row < f->rows - 1 && height >= f->heights[f->row + 1])
            f->row++;
        if (height > f->heights[f->row] && f->row < f->rows - 1)
            v = (height - f->heights[f->row]) / (f->heights[f->row + 1] - f->heights[f->row]);
    }
    const double *t = f->table + 4 * (f->row * f->points + j);
    double value = ((t[0] * u + t[1]) * u + t[2]) * u + t[3];
    if (v > 0.0) {
        t += 4 * f->points;
        value += v * (((t[0] * u + t[1]) * u + t[2]) * u + t[3] - value);
    }
    return value;
}

// ---- transfer functions ----------------------------------------------------------------------------------------------

typedef struct {
    int64_t order;
    double transition[MAX_ORDER * MAX_ORDER], before[MAX_ORDER], now[MAX_ORDER], output[MAX_ORDER], through;
    // what changes
    double state[MAX_ORDER], last;
} System;

KNOWN double respond_by(System *s, double input, const int order)
{
    double next[MAX_ORDER], result = s->through * input;
    for (int row = 0; row < order; row++) {
        next[row] = s->before[row] * s->last + s->now[row] * input;
        for (int column = 0; column < order; column++)
            next[row] += s->transition[row * order + column] * s->state[column];
        result += s->output[row] * next[row];
    }
    memcpy(s->state, next, (size_t)order * sizeof(double));
    s->last = input;
    return result;
}

// The next output.
static inline double respond(System *s, double input)
{
    switch (s->order) {
    case 1: return respond_by(s, input, 1);
    case 2: return respond_by(s, input, 2);
    case 3: return respond_by(s, input, 3);
    case 4: return respond_by(s, input, 4);
    case 5: return respond_by(s, input, 5);
    default: return respond_by(s, input, 6);
    }
}

KNOWN double at_rest_by(const System *s, const int order)
{
    double result = 0.0;
    for (int row = 0; row < order; row++) {
        double next = s->before[row] * s->last;
        for (int column = 0; column < order; column++)
            next += s->transition[row * order + column] * s->state[column];
        result += s->output[row] * next;
    }
    return result;
}

// The next output if the input were 0; of order 1 or 2.
static inline double at_rest(const System *s)
{
    return s->order == 1 ? at_rest_by(s, 1) : at_rest_by(s, 2);
}

// ---- cut -------------------------------------------------------------------------------------------------------------

typedef struct {
    int64_t waves;
    double keep, kick, start, order[MAX_LINES], amplitude[MAX_LINES], phase[MAX_LINES];
    // what changes
    double walk;
    int64_t begun;
} Allowance;

typedef struct {
    double step, depth, sign, kc1, mc, wear_factor, per_metre, per_second, radius, compliance, lag_now, mode_now;
    System lag, mode;
    Allowance blank;
    // what changes
    double wear;
    int64_t apart, backwards;
} Cut;

typedef struct {
    double force, depth, feed, allowance, wear, deflection;
} Chip;

static inline double allowance(Allowance *a, double angle, double normal)
{
    a->walk = a->begun ? a->keep * a->walk + a->kick * normal : a->start * normal;
    a->begun = 1;
    double total = a->walk;
    for (int64_t i = 0; i < a->waves; i++)
        total += a->amplitude[i] * sin(a->order[i] * angle + a->phase[i]);
    return total;
}

// `cross` is positive into the part, `displacement` of the tool out of it.
static inline Chip cut(
    Cut *c, double angle, double speed, double cross, double displacement, double feed_velocity, double normal)
{
    Chip chip = {.allowance = allowance(&c->blank, angle, normal), .wear = c->wear};
    chip.feed = feed_velocity * TURN / speed;
    if (chip.feed < 0.0) {
        chip.feed = 0.0;
        c->backwards++;
    }
    const double stiffness = c->kc1 * 1e-3 * pow(chip.feed / 1e-3, 1.0 - c->mc) * (1.0 + c->wear_factor * c->wear);
    const double compliance = c->sign * c->compliance;
    double depth = c->depth + chip.allowance + cross - displacement;
    depth -= compliance * (at_rest(&c->mode) + c->mode_now * at_rest(&c->lag));
    depth /= 1.0 + c->mode_now * c->lag_now * stiffness * compliance;
    if (depth < 0.0) {
        depth = 0.0;
        c->apart++;
    }
    chip.depth = depth;
    chip.force = respond(&c->lag, stiffness * depth);
    chip.deflection = compliance * respond(&c->mode, chip.force);
    if (depth > 0.0)
        c->wear += (c->per_metre * c->radius * speed + c->per_second) * c->step;
    return chip;
}

// ---- servo controllers and feed drives -------------------------------------------------------------------------------

typedef struct {
    int64_t divisor;
    double proportional, integral, derivative, decay, low, high, adc, dac, ramp, approach, set_point;
    // what changes
    double sum, slope, error, wanted, command;
    int64_t saturated, clamped, slowed;
} Pid;

static inline int skipped(int64_t n, int64_t divisor)
{
    return divisor != 1 && n % divisor;
}

static inline double regulate(Pid *p, int64_t n, double measurement)
{
    if (skipped(n, p->divisor))
        return p->command;
    const double way = p->set_point - p->wanted;
    double move = p->approach * way;
    if (p->ramp > 0.0)
        move = within(move, -p->ramp, p->ramp);
    const double wanted = move == way ? p->set_point : p->wanted + move;
    p->slowed += wanted != p->set_point;
    p->wanted = wanted;
    const double error = wanted - quantised(measurement, p->adc);
    const double slope = p->decay * p->slope + p->derivative * (error - p->error);
    const double more = p->integral * (error + p->error);
    const double demand = p->proportional * error + slope + p->sum + more;
    if ((demand > p->high && more > 0.0) || (demand < p->low && more < 0.0))
        p->clamped++;
    else
        p->sum += more;
    double command = within(demand, p->low, p->high);
    p->saturated += command != demand;
    if (p->dac > 0.0)
        command = within(quantised(command, p->dac), p->low, p->high);
    p->slope = slope, p->error = error, p->command = command;
    return command;
}

typedef struct {
    int64_t order, divisor;
    double transition[9], weights[3], command_limit;
    // what changes
    double state[3], effort;
    int64_t saturated;
} Feed;

KNOWN void move_by(Feed *f, const int order)
{
    double next[3];
    for (int row = 0; row < order; row++) {
        next[row] = f->weights[row] * f->effort;
        for (int column = 0; column < order; column++)
            next[row] += f->transition[row * order + column] * f->state[column];
    }
    memcpy(f->state, next, (size_t)order * sizeof(double));
}

static inline Motion feed(Feed *f, int64_t n, double command)
{
    if (f->order == 2)
        move_by(f, 2);
    else
        move_by(f, 3);
    if (!skipped(n, f->divisor)) {
        f->effort = within(command, -f->command_limit, f->command_limit);
        f->saturated += fabs(command) > f->command_limit;
    }
    return (Motion){f->state[0], f->state[1], f->effort};
}

// ---- signals ---------------------------------------------------------------------------------------------------------

// Of a chunk keep what the next one looks back at: it stands before the signal.
static inline void keep(double *signal, int64_t older, int64_t samples)
{
    memmove(signal - older, signal - older + samples, (size_t)older * sizeof(double));
}

#endif
