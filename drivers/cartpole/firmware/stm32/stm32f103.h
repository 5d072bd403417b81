/* The registers of the STM32F103 that these programs use, by the names of its reference manual (RM0008). */
#ifndef STM32F103_H
#define STM32F103_H

#include <stdint.h>

#ifdef HOST
/* On a host a test stands in for the chip (host/stm32.c). */
volatile uint32_t *chip_register(uint32_t address);
#define REGISTER(address) (*chip_register(address))
#else
#define REGISTER(address) (*(volatile uint32_t *)(address))
#endif

#define RCC_CR REGISTER(0x40021000UL)
#define RCC_CFGR REGISTER(0x40021004UL)
#define RCC_APB2ENR REGISTER(0x40021018UL)
#define RCC_APB1ENR REGISTER(0x4002101CUL)
#define HSEON (1UL << 16)
#define HSERDY (1UL << 17)
#define PLLON (1UL << 24)
#define PLLRDY (1UL << 25)
#define PPRE1_HALF (4UL << 8)
#define PLLSRC_HSE (1UL << 16)
#define PLLMUL_9 (7UL << 18)
#define SW_PLL 2UL
#define AFIOEN (1UL << 0)
#define IOPAEN (1UL << 2)
#define IOPBEN (1UL << 3)
#define IOPCEN (1UL << 4)
#define USART1EN (1UL << 14)
#define TIM2EN (1UL << 0)
#define TIM3EN (1UL << 1)
#define TIM4EN (1UL << 2)
#define CANEN (1UL << 25)

#define FLASH_ACR REGISTER(0x40022000UL)
#define PRFTBE (1UL << 4)
#define LATENCY_2 2UL

#define AFIO_MAPR REGISTER(0x40010004UL)
#define TIM2_REMAP_PARTIAL_1 (1UL << 8) /* CH1 on PA15, CH2 on PB3. */
#define CAN_REMAP_PB8_PB9 (2UL << 13)
#define SWJ_CFG_SWD_ONLY (2UL << 24)    /* Without JTAG, whose pins PA15 and PB3 are. */

#define GPIOA 0x40010800UL
#define GPIOB 0x40010C00UL
#define GPIOC 0x40011000UL
#define GPIO_CRL(port) REGISTER((port) + 0x00)
#define GPIO_CRH(port) REGISTER((port) + 0x04)
#define GPIO_IDR(port) REGISTER((port) + 0x08)
#define GPIO_BSRR(port) REGISTER((port) + 0x10)
/* Modes of a pin, 4 bits each in CRL (pins 0 to 7) and CRH (8 to 15); 4 is a floating input, as after a reset. */
#define PIN_OUTPUT 2UL
#define PIN_PULLED_INPUT 8UL /* Up if its output bit is set. */
#define PIN_PERIPHERAL 9UL   /* Push-pull, 10 MHz. */

#define TIM2 0x40000000UL
#define TIM3 0x40000400UL
#define TIM4 0x40000800UL
#define TIM_CR1(timer) REGISTER((timer) + 0x00)
#define TIM_SMCR(timer) REGISTER((timer) + 0x08)
#define TIM_EGR(timer) REGISTER((timer) + 0x14)
#define TIM_CCMR1(timer) REGISTER((timer) + 0x18)
#define TIM_CCER(timer) REGISTER((timer) + 0x20)
#define TIM_CNT(timer) REGISTER((timer) + 0x24)
#define TIM_PSC(timer) REGISTER((timer) + 0x28)
#define TIM_ARR(timer) REGISTER((timer) + 0x2C)
#define TIM_CCR1(timer) REGISTER((timer) + 0x34)
#define CEN 1UL
#define ARPE (1UL << 7)
#define UG 1UL
#define CC1E 1UL
#define SMS_BOTH_EDGES 3UL
#define ENCODER_INPUTS 0x9191UL  /* CH1 and CH2 are TI1 and TI2, each stable for 8 samples at 9 MHz. */
#define PWM_MODE_1_PRELOADED 0x68UL

#define USART1_SR REGISTER(0x40013800UL)
#define USART1_DR REGISTER(0x40013804UL)
#define USART1_BRR REGISTER(0x40013808UL)
#define USART1_CR1 REGISTER(0x4001380CUL)
#define RXNE (1UL << 5)
#define TXE (1UL << 7)
#define RE (1UL << 2)
#define TE (1UL << 3)
#define RXNEIE (1UL << 5)
#define UE (1UL << 13)
#define USART1_IRQ 37
void usart1_interrupt(void); /* Of a program that enables it. */

#ifdef QEMU
#define CAN_BASE 0x20001000UL /* It has no CAN controller: a test reads and writes this memory. */
#else
#define CAN_BASE 0x40006400UL
#endif
#define CAN_MCR REGISTER(CAN_BASE + 0x000UL)
#define CAN_MSR REGISTER(CAN_BASE + 0x004UL)
#define CAN_TSR REGISTER(CAN_BASE + 0x008UL)
#define CAN_RF0R REGISTER(CAN_BASE + 0x00CUL)
#define CAN_ESR REGISTER(CAN_BASE + 0x018UL)
#define CAN_BTR REGISTER(CAN_BASE + 0x01CUL)
#define CAN_TIR(mailbox) REGISTER(CAN_BASE + 0x180UL + 0x10UL * (mailbox))
#define CAN_TDTR(mailbox) REGISTER(CAN_BASE + 0x184UL + 0x10UL * (mailbox))
#define CAN_TDLR(mailbox) REGISTER(CAN_BASE + 0x188UL + 0x10UL * (mailbox))
#define CAN_TDHR(mailbox) REGISTER(CAN_BASE + 0x18CUL + 0x10UL * (mailbox))
#define CAN_RI0R REGISTER(CAN_BASE + 0x1B0UL)
#define CAN_RDT0R REGISTER(CAN_BASE + 0x1B4UL)
#define CAN_RDL0R REGISTER(CAN_BASE + 0x1B8UL)
#define CAN_RDH0R REGISTER(CAN_BASE + 0x1BCUL)
#define CAN_FMR REGISTER(CAN_BASE + 0x200UL)
#define CAN_FM1R REGISTER(CAN_BASE + 0x204UL)
#define CAN_FS1R REGISTER(CAN_BASE + 0x20CUL)
#define CAN_FFA1R REGISTER(CAN_BASE + 0x214UL)
#define CAN_FA1R REGISTER(CAN_BASE + 0x21CUL)
#define CAN_FR1(bank) REGISTER(CAN_BASE + 0x240UL + 8UL * (bank))
#define CAN_FR2(bank) REGISTER(CAN_BASE + 0x244UL + 8UL * (bank))
#define INRQ (1UL << 0)
#define TXFP (1UL << 2)
#define ABOM (1UL << 6)
#define INAK (1UL << 0)
#define TME(mailbox) (1UL << (26 + (mailbox)))
#define FMP0 3UL
#define FOVR0 (1UL << 4)
#define RFOM0 (1UL << 5)
#define BOFF (1UL << 2)
#define TXRQ 1UL
#define IDE_RTR 6UL
#define FINIT 1UL

#define IWDG_KR REGISTER(0x40003000UL)
#define IWDG_PR REGISTER(0x40003004UL)
#define IWDG_RLR REGISTER(0x40003008UL)
#define IWDG_START 0xCCCCUL
#define IWDG_UNLOCK 0x5555UL
#define IWDG_RELOAD 0xAAAAUL

/* The Cortex-M3's own. */
#define SYST_CSR REGISTER(0xE000E010UL)
#define SYST_RVR REGISTER(0xE000E014UL)
#define SYST_CVR REGISTER(0xE000E018UL)
#define SYST_RUN 5UL
#define SYST_COUNTFLAG (1UL << 16)
#define NVIC_ISER1 REGISTER(0xE000E104UL)
#define SCB_AIRCR REGISTER(0xE000ED0CUL)
#define SCB_RESET 0x05FA0004UL

#define UNIQUE_ID(word) REGISTER(0x1FFFF7E8UL + 4UL * (word))

#endif
