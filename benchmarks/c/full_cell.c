// SPDX-License-Identifier: Apache-2.0
// The full cell: both channels, the cut, and the force and the position loop with their decoupler and feed drives.

#include "laws.h"

// The signals of a chunk; those that come back have `delay` older samples before them.
typedef struct {
    double *angle, *speed;
    uint8_t *index_pulse;
    double *angle_true, *speed_true;
    double *coarse_command, *coarse_position, *coarse_velocity, *coarse_effort, *coarse_measured;
    double *fine_command, *fine_position, *fine_velocity, *fine_effort, *fine_measured;
    double *force_command, *force_set_point, *force_error;
    double *edge_command, *edge_set_point, *edge_error;
    double *longitudinal_command, *longitudinal_set_point, *longitudinal_error;
    double *cross_command, *cross_set_point, *cross_error;
    double *longitudinal_position, *longitudinal_velocity, *longitudinal_effort, *longitudinal_measured;
    double *cross_position, *cross_velocity, *cross_effort, *cross_measured;
    double *reference, *displacement, *error, *measured_error, *height;
    double *force, *measured_force, *depth_of_cut, *feed, *allowance, *wear, *deflection;
} Signals;

typedef struct {
    int64_t delay, coarse_delay, force_delay, edge_delay, deflection_delay;
    const double *normal;  // a number for each sample that comes
    Spindle spindle;
    Channel coarse, fine;
    Coarse drive;
    Fine piezo;
    Pid force, edge;
    System k1, k2;
    Feed longitudinal, cross;
    Form form;
    Cut cut;
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

        double error = s->measured_error[k - delay] + s->fine_measured[k - delay];
        s->coarse_command[k] = control(&cell->coarse, arrived, angle, speed, s->angle[k - delay], error);
        error = s->measured_error[k - delay];
        s->fine_command[k] = control(&cell->fine, arrived, angle, speed, s->angle[k - delay], error);

        const Motion coarse = drive(&cell->drive, s->coarse_command + k - cell->coarse_delay);
        s->coarse_position[k] = s->coarse_measured[k] = coarse.position;
        s->coarse_velocity[k] = coarse.velocity;
        s->coarse_effort[k] = coarse.effort;
        const Motion fine = extend(&cell->piezo, s->fine_command[k]);
        s->fine_position[k] = s->fine_measured[k] = fine.position;
        s->fine_velocity[k] = fine.velocity;
        s->fine_effort[k] = fine.effort;

        // The slide is positive into the part, the deflection out of it.
        const double force = s->measured_force[k - cell->force_delay];
        const double edge = s->cross_measured[k - cell->edge_delay] - s->deflection[k - cell->edge_delay];
        s->force_set_point[k] = s->longitudinal_set_point[k] = cell->force.set_point;
        s->force_error[k] = s->longitudinal_error[k] = cell->force.set_point - force;
        s->force_command[k] = regulate(&cell->force, n, force);
        s->edge_set_point[k] = s->cross_set_point[k] = cell->edge.set_point;
        s->edge_error[k] = s->cross_error[k] = cell->edge.set_point - edge;
        s->edge_command[k] = regulate(&cell->edge, n, edge);
        s->longitudinal_command[k] = s->force_command[k] - respond(&cell->k1, s->edge_command[k]);
        s->cross_command[k] = s->edge_command[k] - respond(&cell->k2, s->force_command[k]);

        const Motion longitudinal = feed(&cell->longitudinal, n, s->longitudinal_command[k]);
        s->longitudinal_position[k] = s->longitudinal_measured[k] = longitudinal.position;
        s->longitudinal_velocity[k] = longitudinal.velocity;
        s->longitudinal_effort[k] = longitudinal.effort;
        const Motion cross = feed(&cell->cross, n, s->cross_command[k]);
        s->cross_position[k] = s->cross_measured[k] = cross.position;
        s->cross_velocity[k] = cross.velocity;
        s->cross_effort[k] = cross.effort;

        s->height[k] = cell->form.start + longitudinal.position;
        s->reference[k] = deviation(&cell->form, angle, s->height[k]);
        s->displacement[k] = coarse.position + fine.position;
        s->measured_error[k] = s->reference[k] - coarse.position - fine.position;
        s->error[k] = s->reference[k] - s->displacement[k] + cross.position;
        s->error[k] -= s->deflection[k - cell->deflection_delay];

        // The blank has the form that is wanted.
        const double beyond = s->displacement[k] - s->reference[k];
        const Chip chip = cut(
            &cell->cut, angle, speed, cross.position, beyond, longitudinal.velocity, cell->normal[k]);
        s->force[k] = s->measured_force[k] = chip.force;
        s->depth_of_cut[k] = chip.depth;
        s->feed[k] = chip.feed;
        s->allowance[k] = chip.allowance;
        s->wear[k] = chip.wear;
        s->deflection[k] = chip.deflection;
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
    keep(s->measured_force, cell->force_delay, samples);
    keep(s->cross_measured, cell->edge_delay, samples);
    keep(s->deflection, cell->edge_delay > cell->deflection_delay ? cell->edge_delay : cell->deflection_delay, samples);
}

// Step through the samples from `first` on, in chunks of at most `size`.
void cell_run(Cell *cell, int64_t first, int64_t samples, int64_t size)
{
    for (const int64_t end = first + samples; first < end;) {
        const int64_t now = end - first < size ? end - first : size;
        chunk(cell, first, now);
        keep_some(cell, now);
        first += now;
        cell->normal += now;
    }
}
