/* SPDX-License-Identifier: Apache-2.0
 *
 * What Python and C do differently: arrays that know their size, remainders, indices and slices. Written for the
 * functions that lathe export c prints; see lathe.h.
 */
#ifndef LATHE_KERNELS_H
#define LATHE_KERNELS_H

#include "lathe.h"

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

/* An array whose elements follow one another. */
#define LATHE_ARRAY(type, name)                                                                                        \
    typedef struct {                                                                                                   \
        type *data;                                                                                                    \
        int64_t size;                                                                                                  \
    } name##_array;                                                                                                    \
    typedef struct {                                                                                                   \
        type *data;                                                                                                    \
        int64_t rows, columns;                                                                                         \
    } name##_matrix;                                                                                                   \
    typedef struct {                                                                                                   \
        type *data;                                                                                                    \
        int64_t planes, rows, columns;                                                                                 \
    } name##_cube;                                                                                                     \
    /* Elements from `begin` up to `end`; both count from the end if they are below 0. */                              \
    static inline name##_array name##_part(name##_array all, int64_t begin, int64_t end)                               \
    {                                                                                                                  \
        begin = begin < 0 ? begin + all.size : begin;                                                                  \
        end = end < 0 ? end + all.size : end;                                                                          \
        begin = begin < 0 ? 0 : begin > all.size ? all.size : begin;                                                   \
        end = end < begin ? begin : end > all.size ? all.size : end;                                                   \
        return (name##_array){all.data + begin, end - begin};                                                          \
    }                                                                                                                  \
    static inline name##_array name##_row(name##_matrix all, int64_t row)                                              \
    {                                                                                                                  \
        return (name##_array){all.data + row * all.columns, all.columns};                                              \
    }                                                                                                                  \
    static inline name##_matrix name##_plane(name##_cube all, int64_t plane)                                           \
    {                                                                                                                  \
        return (name##_matrix){all.data + plane * all.rows * all.columns, all.rows, all.columns};                      \
    }                                                                                                                  \
    static inline name##_matrix name##_rows(name##_matrix all, int64_t end)                                            \
    {                                                                                                                  \
        return (name##_matrix){all.data, end < all.rows ? end : all.rows, all.columns};                                \
    }                                                                                                                  \
    static inline void name##_put(name##_array into, name##_array values)                                              \
    {                                                                                                                  \
        if (into.size > 0)                                                                                             \
            (void)memmove(into.data, values.data, (size_t)into.size * sizeof *into.data);                              \
    }                                                                                                                  \
    static inline void name##_fill(name##_array into, type value)                                                      \
    {                                                                                                                  \
        for (int64_t n = 0; n < into.size; n++)                                                                        \
            into.data[n] = value;                                                                                      \
    }

LATHE_ARRAY(double, real)
LATHE_ARRAY(int64_t, int)
LATHE_ARRAY(uint8_t, octet)

typedef struct { /* arrays of one size */
    void *const *table;
    int64_t count, size;
} ports;

static inline real_array port(ports all, int64_t number)
{
    return (real_array){all.table[number < 0 ? number + all.count : number], all.size};
}

static inline int64_t at(int64_t index, int64_t size)
{
    return index < 0 ? index + size : index;
}

static inline real_array real_empty(lathe_room *room, int64_t size)
{
    size_t bytes = ((size_t)size * sizeof(double) + 63) / 64 * 64;
    real_array made = {(double *)room->next, size};
    if (bytes > (size_t)(room->end - room->next)) {
        room->full = true;
        made.size = 0;
    } else {
        room->next += bytes;
    }
    return made;
}

static inline real_array real_full(lathe_room *room, int64_t size, double value)
{
    real_array made = real_empty(room, size);
    real_fill(made, value);
    return made;
}

static inline real_array real_copy(lathe_room *room, real_array all)
{
    real_array made = real_empty(room, all.size);
    real_put(made, all);
    return made;
}

static inline real_array real_joined(lathe_room *room, real_array one, real_array other)
{
    real_array made = real_empty(room, one.size + other.size);
    real_put(real_part(made, 0, one.size), one);
    real_put(real_part(made, one.size, made.size), other);
    return made;
}

/* The sign of a remainder is that of the divisor, and a quotient is rounded down. */
static inline int64_t int_remainder(int64_t one, int64_t other)
{
    int64_t rest = other ? one % other : 0;
    return rest && (rest < 0) != (other < 0) ? rest + other : rest;
}

static inline int64_t int_quotient(int64_t one, int64_t other)
{
    int64_t whole = other ? one / other : 0;
    return other && one % other && (one < 0) != (other < 0) ? whole - 1 : whole;
}

static inline double real_remainder(double one, double other)
{
    double rest = fmod(one, other);
    if (rest != 0.0)
        return (other < 0.0) != (rest < 0.0) ? rest + other : rest;
    return copysign(0.0, other);
}

static inline double real_quotient(double one, double other)
{
    if (other == 0.0)
        return one / other;
    double rest = fmod(one, other), whole = (one - rest) / other;
    if (rest != 0.0 && (other < 0.0) != (rest < 0.0))
        whole -= 1.0;
    if (whole == 0.0)
        return copysign(0.0, one / other);
    double down = floor(whole);
    return whole - down > 0.5 ? down + 1.0 : down;
}

static inline double real_min(double one, double other) { return other < one ? other : one; }
static inline double real_max(double one, double other) { return other > one ? other : one; }
static inline int64_t int_min(int64_t one, int64_t other) { return other < one ? other : one; }
static inline int64_t int_max(int64_t one, int64_t other) { return other > one ? other : one; }
static inline int64_t int_abs(int64_t value) { return value < 0 ? -value : value; }
static inline double sign(double value) { return value > 0.0 ? 1.0 : value < 0.0 ? -1.0 : value; }
static inline double real_power_2(double value) { return value * value; }
static inline double real_power_3(double value) { return value * (value * value); }
static inline double real_power_4(double value) { return real_power_2(value * value); }
static inline int64_t int_power_2(int64_t value) { return value * value; }

static inline double real_sum(real_array all)
{
    double sum = 0.0;
    for (int64_t n = 0; n < all.size; n++)
        sum += all.data[n];
    return sum;
}

typedef struct {
    double real, imag;
} complex_number;

static inline complex_number complex_sum(complex_number one, complex_number other)
{
    return (complex_number){one.real + other.real, one.imag + other.imag};
}

static inline complex_number complex_difference(complex_number one, complex_number other)
{
    return (complex_number){one.real - other.real, one.imag - other.imag};
}

static inline complex_number complex_product(complex_number one, complex_number other)
{
    return (complex_number){one.real * other.real - one.imag * other.imag,
                            one.real * other.imag + one.imag * other.real};
}

static inline complex_number complex_quotient(complex_number one, complex_number other)
{
    if (fabs(other.real) >= fabs(other.imag)) {
        double ratio = other.imag / other.real, size = other.real + other.imag * ratio;
        return (complex_number){(one.real + one.imag * ratio) / size, (one.imag - one.real * ratio) / size};
    }
    double ratio = other.real / other.imag, size = other.real * ratio + other.imag;
    return (complex_number){(one.real * ratio + one.imag) / size, (one.imag * ratio - one.real) / size};
}

/* Places in a sorted array; NaN is behind every number. */
static inline int64_t search_left(real_array all, double value)
{
    int64_t low = 0, high = all.size;
    while (low < high) {
        int64_t middle = low + (high - low) / 2;
        if (all.data[middle] < value || (isnan(value) && !isnan(all.data[middle])))
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

static inline int64_t search_right(real_array all, double value)
{
    int64_t low = 0, high = all.size;
    while (low < high) {
        int64_t middle = low + (high - low) / 2;
        if (value < all.data[middle] || (isnan(all.data[middle]) && !isnan(value)))
            high = middle;
        else
            low = middle + 1;
    }
    return low;
}

#endif
