/* SPDX-License-Identifier: Apache-2.0
 *
 * Runs an exported library CELL on the inputs that the engine had, with bad inputs between them and damaged states.
 *
 *     hostile REFERENCE TRIES FLIPS
 *
 * Half of the bad inputs cannot be used: they are refused, the outputs are held, and afterwards the library goes on with
 * the bits of the engine. The others are within their range, but wild: whatever the library makes of them, no output is
 * beyond its range.
 */
#include <float.h>
#include <inttypes.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const lathe_cell *cell = &CELL;
static int64_t samples, events;
static char **given, **wanted, **in, **out;
static uint64_t state = 20261128;

static uint64_t draw(void)
{
    state = state * 6364136223846793005u + 1442695040888963407u;
    return state >> 33;
}

static void fail(const char *format, ...)
{
    va_list rest;
    va_start(rest, format);
    vprintf(format, rest);
    va_end(rest);
    puts("");
    exit(1);
}

static void *get(FILE *file, size_t size)
{
    void *content = malloc(size ? size : 1);
    if (!content || fread(content, 1, size, file) != size)
        fail("the reference cannot be read");
    return content;
}

static void check_range(int status, int32_t n)
{
    for (int32_t k = 0; k < cell->outputs; k++)
        for (int32_t j = 0; j < n; j++) {
            double value = cell->output[k].bytes == 8 ? ((double *)out[k])[j] : ((uint8_t *)out[k])[j];
            if (!(cell->output[k].low <= value && value <= cell->output[k].high))
                fail("%s = %g with status %d", cell->output[k].name, value, status);
        }
}

static int step(void *block, int32_t n)
{
    int status = lathe_step(block, n, (const void *const *)in, (void *const *)out);
    check_range(status, n);
    return status;
}

static void feed(int64_t first, int32_t n)
{
    for (int32_t k = 0; k < cell->inputs; k++)
        memcpy(in[k], given[k] + first * cell->input[k].bytes, (size_t)n * (size_t)cell->input[k].bytes);
}

/* Put a bad value into an input; return whether it must be refused. */
static int spoil(int32_t n, int wild)
{
    static const double bad[] = {NAN, -NAN, HUGE_VAL, -HUGE_VAL, 1e300, -1e300, DBL_MAX};
    const lathe_signal *signal = &cell->input[draw() % (uint64_t)cell->inputs];
    char *to = in[signal - cell->input];
    uint64_t at = draw() % (uint64_t)n;
    if (signal->bytes == 1) {
        uint8_t value = (uint8_t)draw();
        ((uint8_t *)to)[at] = value;
        return value > signal->high;
    }
    double span = signal->high - signal->low;
    double near[] = {signal->low, signal->high, -0.0, DBL_TRUE_MIN, signal->low + span * (double)draw() / 2147483648.0,
                     ((double *)to)[at] * -1.0, ((double *)to)[at] + span * 1e-6, nextafter(signal->high, HUGE_VAL)};
    uint64_t which = draw();
    double value = wild ? near[which % (sizeof near / sizeof *near)] : bad[which % (sizeof bad / sizeof *bad)];
    ((double *)to)[at] = value;
    return !(signal->low <= value && value <= signal->high);
}

int main(int count, char **arguments)
{
    FILE *file = fopen(arguments[1], "rb");
    int64_t tries = atoll(arguments[2]), flips = atoll(arguments[3]), first = 0, refused = 0, stopped = 0, taken = 0;
    if (count != 4 || !file)
        fail("hostile REFERENCE TRIES FLIPS");
    int64_t *counts = get(file, 2 * sizeof *counts);
    samples = counts[0];
    events = counts[1];
    free(counts);
    char *event = get(file, (size_t)events * 24);
    given = calloc((size_t)cell->inputs + 1, sizeof *given);
    in = calloc((size_t)cell->inputs + 1, sizeof *in);
    wanted = calloc((size_t)cell->outputs, sizeof *wanted);
    out = calloc((size_t)cell->outputs, sizeof *out);
    for (int32_t k = 0; k < cell->inputs; k++) {
        given[k] = get(file, (size_t)samples * (size_t)cell->input[k].bytes);
        in[k] = malloc((size_t)cell->block * 8);
    }
    for (int32_t k = 0; k < cell->outputs; k++) {
        wanted[k] = get(file, (size_t)samples * (size_t)cell->output[k].bytes);
        out[k] = malloc((size_t)cell->block * 8);
    }
    fclose(file);
    if (events)
        memcpy(&samples, event, sizeof samples); /* only up to the first one */
    free(event);
    size_t size = (cell->size + LATHE_ALIGNED - 1) / LATHE_ALIGNED * LATHE_ALIGNED;
    char *block = aligned_alloc(LATHE_ALIGNED, size), *saved = calloc(1, cell->saved);
    memset(block, 0, size);
    if (lathe_step(block, 1, (const void *const *)in, NULL) != LATHE_REFUSED || lathe_sample(block) != -1 ||
        lathe_save(block, saved) != LATHE_REFUSED || lathe_restore(block, saved, cell->saved) != LATHE_REFUSED ||
        lathe_set(block, 0, 0.0) != LATHE_REFUSED || strcmp(lathe_reason_text(block), "no block"))
        fail("a zeroed block is taken for one");
    lathe_init(cell, block);
    if (lathe_restore(block, saved, cell->saved) != LATHE_REFUSED)
        fail("a zeroed state is restored");
    for (int64_t k = 0; k < tries;) {
        int32_t n = (int32_t)(1 + draw() % (uint64_t)cell->block);
        if (first + n > samples) {
            lathe_init(cell, block);
            first = 0;
            continue;
        }
        feed(first, n);
        if (cell->inputs && draw() % 4 == 0) {
            int wild = draw() % 16 == 0, must = spoil(n, wild), status = step(block, n);
            k++;
            if (must != (status == LATHE_INPUT))
                fail("try %" PRId64 ": a bad input gives %d", k, status);
            if (status == LATHE_INPUT) {
                refused++;
                for (int32_t o = 0; o < cell->outputs && first; o++)
                    for (int32_t j = 0; j < n; j++) {
                        size_t bytes = (size_t)cell->output[o].bytes;
                        if (memcmp(out[o] + (size_t)j * bytes, wanted[o] + (size_t)(first - 1) * bytes, bytes))
                            fail("%s is not held", cell->output[o].name);
                    }
                continue;
            }
            stopped += status == LATHE_STOPPED;
            taken += status == LATHE_DONE;
            for (int more = 0; more < 50 && first + 2 * n < samples; more++, first += n) {
                feed(first + n, n);
                if (step(block, n) == LATHE_DONE && status == LATHE_STOPPED)
                    fail("a stopped library goes on");
            }
            lathe_init(cell, block); /* its state is another one than that of the engine */
            first = 0;
            continue;
        }
        if (!cell->inputs)
            k++;
        int status = step(block, n);
        if (status != LATHE_DONE)
            fail("sample %" PRId64 ": %s: %s", first, lathe_reason_name(block), lathe_reason_text(block));
        for (int32_t o = 0; o < cell->outputs; o++) {
            size_t bytes = (size_t)cell->output[o].bytes;
            if (memcmp(out[o], wanted[o] + (size_t)first * bytes, (size_t)n * bytes))
                fail("%s has other bits at sample %" PRId64, cell->output[o].name, first);
        }
        first += n;
    }
    lathe_save(block, saved);
    if (lathe_restore(block, saved, cell->saved - 1) != LATHE_REFUSED)
        fail("a short state is restored");
    for (int64_t k = 0; k < flips; k++) {
        uint64_t bit = (draw() << 20 ^ draw()) % (8 * cell->saved);
        if (k < 8 * 256)
            bit = (uint64_t)k; /* each of the head */
        saved[bit / 8] ^= (char)(1 << bit % 8);
        if (lathe_restore(block, saved, cell->saved) != LATHE_REFUSED)
            fail("bit %" PRIu64 " flipped: restored", bit);
        saved[bit / 8] ^= (char)(1 << bit % 8);
    }
    if (lathe_restore(block, saved, cell->saved) != LATHE_DONE)
        fail("a sound state is refused");
    printf("%" PRId64 " refused, %" PRId64 " stopped, %" PRId64 " taken, %" PRId64 " flips\n", refused, stopped, taken, flips);
    free(block);
    free(saved);
    return 0;
}
