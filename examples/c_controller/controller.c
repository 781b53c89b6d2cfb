/* SPDX-License-Identifier: Apache-2.0
 *
 * The exported law of a learning_controller as a program of its own: it takes encoder angles, speeds and errors from a
 * socket and answers with the command of the drive. udp_member.py is the other side.
 *
 *     controller PORT
 */
#define _POSIX_C_SOURCE 200809L
#include "learning_controller.h"

#include <arpa/inet.h>
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <time.h>

#define MOST 3200 /* samples in a datagram */

typedef struct {
    int64_t first, samples; /* 0 samples: the end */
    double signal[3 * MOST];
} datagram;

_Static_assert(LEARNING_CONTROLLER_INPUTS == 3, "export it with --set learning_controller.identify=false");

static char block[LEARNING_CONTROLLER_BYTES] __attribute__((aligned(LATHE_ALIGNED)));
static datagram question, answer;

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

int main(int count, char **arguments)
{
    const lathe_cell *law = &learning_controller;
    struct sockaddr_in here = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)}, there;
    here.sin_port = htons((uint16_t)(count > 1 ? atoi(arguments[1]) : 47000));
    int link = socket(AF_INET, SOCK_DGRAM, 0);
    if (link < 0 || bind(link, (struct sockaddr *)&here, sizeof here)) {
        perror("socket");
        return 2;
    }
    lathe_init(law, block);
    double start = 0.0, latest = 0.0, longest = 0.0, spent = 0.0;
    int64_t blocks = 0;
    for (;; blocks++) {
        socklen_t length = sizeof there;
        ssize_t size = recvfrom(link, &question, sizeof question, 0, (struct sockaddr *)&there, &length);
        double begin = now();
        int32_t n = (int32_t)question.samples;
        if (size < 16 || n < 0 || n > MOST || size != 16 + 3 * n * 8 || question.first != lathe_sample(block)) {
            fprintf(stderr, "a datagram that does not fit at sample %" PRId64 "\n", lathe_sample(block));
            return 1;
        }
        if (!n)
            break;
        if (!blocks)
            start = begin;
        /* Against the pace of the first block: what comes later has waited in the cell or in this machine. */
        double late = begin - start - (double)question.first * law->step;
        latest = late > latest ? late : latest;
        const void *inputs[] = {question.signal, question.signal + n, question.signal + 2 * n};
        void *outputs[] = {answer.signal};
        int status = lathe_step(block, n, inputs, outputs);
        if (status != LATHE_DONE) { /* the last command is in the answer: a machine would hold it, or bring it to rest */
            fprintf(stderr, "%s: %s\n", lathe_reason_name(block), lathe_reason_text(block));
            return 1;
        }
        answer.first = question.first;
        answer.samples = n;
        double took = now() - begin;
        spent += took;
        longest = took > longest ? took : longest;
        sendto(link, &answer, 16 + (size_t)n * 8, 0, (struct sockaddr *)&there, length);
    }
    printf("%" PRId64 " blocks, %" PRId64 " samples: %.0f ns a sample, longest block %.0f us, latest block %.2f ms late\n",
           blocks, lathe_sample(block), spent / (double)lathe_sample(block) * 1e9, longest * 1e6, latest * 1e3);
    return 0;
}
