// SPDX-License-Identifier: Apache-2.0
// The two-channel cell: encoder -> learning controller -> coarse drive -> fine controller -> piezo drive -> tool.

#include "laws.h"

// The signals of a chunk; those that come back have `delay` older samples before them.
typedef struct {
    double *angle, *speed;
    uint8_t *index_pulse;
    double *angle_true, *speed_true;
    double *coarse_command, *coarse_position, *coarse_velocity, *coarse_effort, *coarse_measured;
    double *fine_command, *fine_position, *fine_velocity, *fine_effort, *fine_measured;
    double *reference, *displacement, *error, *measured_error, *height;
} Signals;

typedef struct {
    int64_t delay, coarse_delay;
    Spindle spindle;
    Channel coarse, fine;
    Coarse drive;
    Fine piezo;
    Form form;
    Signals signals;
} Cell;

static void chunk(Cell *restrict cell, int64_t first, int64_t samples)
{
    Signals *s = &cell->signals;
    const int64_t delay = cell->delay;
    for (int64_t k = 0; k < samples; k++) {
        const int64_t n = first + k;
        const int arrived = n >= delay;

        s->index_pulse[k] = (uint8_t)turn(&cell->spindle, n, s->angle + k, s->speed + k);
        const double angle = s->angle_true[k] = s->angle[k], speed = s->speed_true[k] = s->speed[k];

        // The coarse channel sees what its own drive leaves: the error and what the fine one takes of it.
        double error = s->measured_error[k - delay] + s->fine_measured[k - delay];
        s->coarse_command[k] = control(&cell->coarse, arrived, angle, speed, s->angle[k - delay], error);

        const Motion coarse = drive(&cell->drive, s->coarse_command + k - cell->coarse_delay);
        s->coarse_position[k] = s->coarse_measured[k] = coarse.position;
        s->coarse_velocity[k] = coarse.velocity;
        s->coarse_effort[k] = coarse.effort;

        error = s->measured_error[k - delay];
        s->fine_command[k] = control(&cell->fine, arrived, angle, speed, s->angle[k - delay], error);

        const Motion fine = extend(&cell->piezo, s->fine_command[k]);
        s->fine_position[k] = s->fine_measured[k] = fine.position;
        s->fine_velocity[k] = fine.velocity;
        s->fine_effort[k] = fine.effort;

        s->height[k] = cell->form.start + cell->form.feed * (angle / TURN);
        s->reference[k] = deviation(&cell->form, angle, s->height[k]);
        s->displacement[k] = s->coarse_position[k] + s->fine_position[k];
        s->measured_error[k] = s->reference[k] - s->coarse_measured[k] - s->fine_measured[k];
        s->error[k] = s->reference[k] - s->displacement[k];
    }
}

// Keep of a chunk what the next one looks back at.
static void keep_some(Cell *cell, int64_t samples)
{
    Signals *s = &cell->signals;
    keep(s->angle, cell->delay, samples);
    keep(s->measured_error, cell->delay, samples);
    keep(s->fine_measured, cell->delay, samples);
    keep(s->coarse_command, cell->coarse_delay + 2, samples);
}

// Step through the samples from `first` on, in chunks of at most `size`.
void cell_run(Cell *cell, int64_t first, int64_t samples, int64_t size)
{
    for (const int64_t end = first + samples; first < end;) {
        const int64_t now = end - first < size ? end - first : size;
        chunk(cell, first, now);
        keep_some(cell, now);
        first += now;
    }
}
