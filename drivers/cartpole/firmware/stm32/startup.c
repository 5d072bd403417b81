/* Start of the Cortex-M3: vectors, variables, then main(). */
#include <stddef.h>

#include "stm32f103.h"

extern uint32_t stack_top, data_load, data_start, data_end, bss_start, bss_end;

int main(void);
void reset(void);

/* A reset switches the motor off: its pins float then. */
static void fail(void)
{
    SCB_AIRCR = SCB_RESET;
    for (;;)
        ;
}

__attribute__((weak)) void usart1_interrupt(void)
{
    fail();
}

typedef void (*vector)(void);
__attribute__((section(".vectors"), used)) static const vector vectors[16 + USART1_IRQ + 1] = {
    (vector)&stack_top,
    reset,
    [2 ... 16 + USART1_IRQ - 1] = fail,
    [16 + USART1_IRQ] = usart1_interrupt,
};

void reset(void)
{
    uint32_t *to, *from = &data_load;
    for (to = &data_start; to < &data_end;)
        *to++ = *from++;
    for (to = &bss_start; to < &bss_end;)
        *to++ = 0;
    main();
    fail();
}

/* The compiler may call these for copies of structures. */
__attribute__((used)) void *memcpy(void *to, const void *from, size_t size)
{
    uint8_t *out = to;
    const uint8_t *in = from;
    while (size--)
        *out++ = *in++;
    return to;
}

__attribute__((used)) void *memset(void *to, int value, size_t size)
{
    uint8_t *out = to;
    while (size--)
        *out++ = (uint8_t)value;
    return to;
}
