// SPDX-License-Identifier: Apache-2.0
// The two-channel cell in plain C, one sample after the other: the arithmetic of lathe_rc in the same order.
//
// encoder -> learning controller -> coarse drive -> fine controller -> piezo drive -> tool
//
// benchmarks/plain_c.py fills the structures from a scenario, so that no parameter is written twice.

#include <math.h>
#include <stdint.h>
#include <string.h>

#define TURN 6.283185307179586
#define MAX_PLAYS 16

typedef struct {
    int64_t grid, cycle, mask, reach, chunk, looks_ahead;
    double lead_time, constant, gain, ratio, join_below;
    double *memory, *scratch, *forward, *smoothed;
    // what changes
    int64_t point, base, learn_from, joined, seen, ahead;
    double angle[4], error[4], squares, largest;
} Channel;

typedef struct {
    double transition[4], weights[6], part, spring, damper, force_per_current, stroke;
    double x, v;
    int64_t stopped;
} Coarse;

typedef struct {
    int64_t plays, inverse_plays;
    double weight[MAX_PLAYS + 1], threshold[MAX_PLAYS + 1], inverse_weight[MAX_PLAYS + 1], inverse_threshold[MAX_PLAYS + 1];
    double transition[4], weights[4], stroke, full_voltage, decay, now, before;
    double play[MAX_PLAYS], inverse_play[MAX_PLAYS], amplified, applied, extension, x, v;
    int64_t saturated;
} Fine;

typedef struct {
    int64_t rows, points;
    double feed, start_height;
    const double *heights, *table;
    int64_t row;
} Form;

// The signals of a chunk; those that come back have `delay` older samples before them.
typedef struct {
    double *angle, *speed, *angle_true, *speed_true;
    uint8_t *index_pulse;
    double *coarse_command, *coarse_position, *coarse_velocity, *coarse_effort, *coarse_measured;
    double *fine_command, *fine_position, *fine_velocity, *fine_effort, *fine_measured;
    double *reference, *displacement, *error, *measured_error, *height;
} Signals;

typedef struct {
    double step, nominal;
    int64_t delay, coarse_delay;
    double revolution;
    Channel coarse, fine;
    Coarse drive;
    Fine piezo;
    Form form;
    Signals signals;
} Cell;

static inline double cubic(double before, double left, double right, double after, double u)
{
    double c1 = right - before / 3.0 - left / 2.0 - after / 6.0;
    double c2 = (before + right) / 2.0 - left;
    double c3 = (after - before) / 6.0 + (left - right) / 2.0;
    return left + u * (c1 + u * (c2 + u * c3));
}

static void smooth(Channel *c)
{
    const int64_t size = c->chunk + 2 * c->reach, last = size - 1;
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
    for (int64_t k = 0; k < c->chunk; k++)
        c->smoothed[k] = gain * (c->smoothed[k] + ratio * c->forward[k + c->reach]);
}

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
                    if (c->point < c->base || c->point - c->base >= c->chunk) {
                        c->base = c->point / c->chunk * c->chunk;
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

static inline double play(double position, double threshold, double value)
{
    const double low = value - threshold, high = value + threshold;
    const double above = position > low ? position : low;
    return above < high ? above : high;
}

static inline double plays(int64_t n, const double *threshold, const double *weight, double *position, double value)
{
    double result = weight[0] * value;
    for (int64_t i = 0; i < n; i++) {
        position[i] = play(position[i], threshold[i + 1], value);
        result += weight[i + 1] * position[i];
    }
    return result;
}

static inline double clip(double value)
{
    const double above = value > -1.0 ? value : -1.0;
    return above < 1.0 ? above : 1.0;
}

static inline double extend(Fine *f, double set_point)
{
    const double wanted = set_point / f->stroke, within = clip(wanted);
    const double demand = plays(f->inverse_plays, f->inverse_threshold, f->inverse_weight, f->inverse_play, within);
    const double applied = clip(demand);
    f->saturated += wanted != within || fabs(demand) > 1.0 + 1e-9;
    f->amplified = f->decay * f->amplified + f->now * applied + f->before * f->applied;
    f->applied = applied;
    return f->stroke * plays(f->plays, f->threshold, f->weight, f->play, f->amplified);
}

static inline double form_at(Form *f, double angle, double height)
{
    const double place = angle * ((double)f->points / TURN), whole = floor(place), u = place - whole;
    const int64_t j = (int64_t)whole & (f->points - 1);
    double v = 0.0;
    if (f->rows > 1) {
        while (f->row > 0 && !(height > f->heights[f->row]))
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

// Step through samples `first` on.
static void chunk(Cell *restrict cell, int64_t first, int64_t samples)
{
    Signals *s = &cell->signals;
    const int64_t delay = cell->delay;
    for (int64_t k = 0; k < samples; k++) {
        const int64_t n = first + k;
        const int arrived = n >= delay;

        const double angle = cell->nominal * ((double)n * cell->step), whole = floor(angle / TURN);
        s->angle_true[k] = s->angle[k] = angle;
        s->speed_true[k] = s->speed[k] = cell->nominal;
        s->index_pulse[k] = whole > cell->revolution;
        cell->revolution = whole;

        // The coarse channel sees what its own drive leaves: the error and what the fine one takes of it.
        double error = s->measured_error[k - delay] + s->fine_measured[k - delay];
        s->coarse_command[k] = control(&cell->coarse, arrived, angle, s->speed[k], s->angle[k - delay], error);

        Coarse *d = &cell->drive;
        const double *u = s->coarse_command + k - cell->coarse_delay;
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
        s->coarse_position[k] = s->coarse_measured[k] = d->x;
        s->coarse_velocity[k] = d->v;
        s->coarse_effort[k] = (d->spring * (delayed - d->x) - d->damper * d->v) * d->force_per_current;

        error = s->measured_error[k - delay];
        s->fine_command[k] = control(&cell->fine, arrived, angle, s->speed[k], s->angle[k - delay], error);

        Fine *f = &cell->piezo;
        const double extension = extend(f, s->fine_command[k]), before = f->extension;
        const double fx = f->transition[0] * f->x + f->transition[1] * f->v + f->weights[0] * extension + f->weights[1] * before;
        const double fv = f->transition[2] * f->x + f->transition[3] * f->v + f->weights[2] * extension + f->weights[3] * before;
        f->x = fx, f->v = fv, f->extension = extension;
        s->fine_position[k] = s->fine_measured[k] = fx;
        s->fine_velocity[k] = fv;
        s->fine_effort[k] = f->amplified * f->full_voltage;

        s->height[k] = cell->form.start_height + cell->form.feed * (angle / TURN);
        s->reference[k] = form_at(&cell->form, angle, s->height[k]);
        s->displacement[k] = s->coarse_position[k] + s->fine_position[k];
        s->measured_error[k] = s->reference[k] - s->coarse_measured[k] - s->fine_measured[k];
        s->error[k] = s->reference[k] - s->displacement[k];
    }
}

static void keep(double *signal, int64_t older, int64_t samples)
{
    memmove(signal - older, signal - older + samples, (size_t)older * sizeof(double));
}

// Step through samples `first` on and keep what later chunks look back at. A signal starts `delay` after its memory.
void cell_chunk(Cell *cell, int64_t first, int64_t samples)
{
    Signals *s = &cell->signals;
    chunk(cell, first, samples);
    keep(s->angle, cell->delay, samples);
    keep(s->measured_error, cell->delay, samples);
    keep(s->fine_measured, cell->delay, samples);
    keep(s->coarse_command, cell->coarse_delay + 2, samples);
}

// Step through a whole run in chunks of at most `size`.
void cell_run(Cell *cell, int64_t samples, int64_t size)
{
    for (int64_t first = 0; first < samples; first += size)
        cell_chunk(cell, first, samples - first < size ? samples - first : size);
}
