/* SPDX-License-Identifier: Apache-2.0
 *
 * Runs an exported library `law` in float on the inputs of given.h, one sample a call, and prints the CRC-32 of its outputs
 * and the stack that it has used: with a C library of this machine, or on a bare Cortex-M4 by semihosting.
 */
#include "law.h"

#include "given.h"

#include <string.h>

static char block[LAW_BYTES] __attribute__((aligned(LATHE_ALIGNED)));

static uint32_t run(void)
{
    uint32_t checksum = 0;
    lathe_init(&law, block);
    for (int n = 0; n < (int)(sizeof given / sizeof *given); n++) {
        float out[LAW_OUTPUTS];
        const void *in[LAW_INPUTS];
        void *to[LAW_OUTPUTS];
        for (int k = 0; k < LAW_INPUTS; k++)
            in[k] = &given[n][k];
        for (int k = 0; k < LAW_OUTPUTS; k++)
            to[k] = &out[k];
        if (lathe_step(block, 1, in, to) != LATHE_DONE)
            return 0;
        checksum = lathe_checksum(checksum, out, sizeof out);
    }
    return checksum;
}

#ifdef __ARM_ARCH_7EM__
extern char data_begin[], data_end[], data_from[], bss_begin[], bss_end[], stack_top[];

static void host(int call, const void *what)
{
    register int r0 __asm__("r0") = call;
    register const void *r1 __asm__("r1") = what;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
}

static void print(uint32_t number)
{
    char text[10] = {0};
    for (int k = 0; k < 8; k++)
        text[k] = "0123456789abcdef"[number >> (28 - 4 * k) & 15];
    text[8] = '\n';
    host(0x04, text); /* SYS_WRITE0 */
}

static void reset(void)
{
    *(volatile uint32_t *)0xe000ed88 |= 0xf << 20; /* the FPU */
    __asm__ volatile("dsb\nisb");
    memcpy(data_begin, data_from, (size_t)(data_end - data_begin));
    char *here = __builtin_frame_address(0), *low = bss_end;
    memset(bss_begin, 0, (size_t)(bss_end - bss_begin));
    memset(bss_end, 0xaa, (size_t)(here - bss_end) - 256);
    print(run());
    while (*low == (char)0xaa)
        low++;
    print((uint32_t)(stack_top - low));
    host(0x18, (const void *)0x20026); /* SYS_EXIT, done */
}

static void fault(void)
{
    host(0x04, "fault\n");
    host(0x18, (const void *)0x20023);
}

__attribute__((section(".vectors"), used)) static const struct {
    const void *stack;
    void (*handler[6])(void);
} vectors = {stack_top, {reset, fault, fault, fault, fault, fault}};
#else
#include <stdio.h>

int main(void)
{
    printf("%08x\n", (unsigned)run());
    return 0;
}
#endif
