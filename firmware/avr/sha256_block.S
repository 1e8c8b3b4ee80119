; void sha256_block(uint32_t state[8], const uint8_t block[64]): FIPS 180-4, 6.2.2, for the ATmega2560.
;
; The compiler keeps the eight working variables in memory, moves all of them in each round, and shifts 32 bits by a loop. Here eight rounds
; are written out, so that the variables stay where they are and change their names; a, e and b ^ c stay in registers. A rotation takes whole
; bytes by naming other registers, and at most three single bits for what is left.
#include <avr/io.h>

#define VARIABLES 0  /* a to h, on the stack from Y on */
#define EIGHTS 32    /* how often eight rounds are still to be done */
#define WORDS 33     /* the last 16 words of the message schedule */
#define FRAME 97

.macro rotate_left u0, u1, u2, u3
    lsl \u0
    rol \u1
    rol \u2
    rol \u3
    adc \u0, r1
.endm

.macro rotate_right u0, u1, u2, u3
    bst \u0, 0
    lsr \u3
    ror \u2
    ror \u1
    ror \u0
    bld \u3, 7
.endm

.macro xor4 u0, u1, u2, u3, v0, v1, v2, v3
    eor \u0, \v0
    eor \u1, \v1
    eor \u2, \v2
    eor \u3, \v3
.endm

.macro add4 u0, u1, u2, u3, v0, v1, v2, v3
    add \u0, \v0
    adc \u1, \v1
    adc \u2, \v2
    adc \u3, \v3
.endm

.macro load4 u0, u1, u2, u3, pointer, at
    ldd \u0, \pointer+\at
    ldd \u1, \pointer+\at+1
    ldd \u2, \pointer+\at+2
    ldd \u3, \pointer+\at+3
.endm

.macro store4 pointer, at, u0, u1, u2, u3
    std \pointer+\at, \u0
    std \pointer+\at+1, \u1
    std \pointer+\at+2, \u2
    std \pointer+\at+3, \u3
.endm

; Ch(e, f, g) = g ^ (e & (f ^ g)), a byte of it; the carry passes.
.macro choose e, f, g
    ldd r18, Y+\f
    ldd r0, Y+\g
    eor r18, r0
    and r18, \e
    eor r18, r0
.endm

; Maj(a, b, c) = ((a ^ b) & (b ^ c)) ^ b, a byte of it, added with `operation`. a ^ b is the next round's b ^ c, in m.
.macro majority operation, n, a, b, m
    ldd r18, Y+\b
    mov r0, r18
    eor r0, \a
    and \m, r0
    eor \m, r18
    \operation \n, \m
    mov \m, r0
.endm

; One round. The variables b, c, d, f, g, h are at these places; a is in the registers a0 to a3, e in r10 to r13, b ^ c in r14 to r17. The new
; a comes into the registers n0 to n3. X is at the round's word, Z at its constant.
.macro round b, d, f, g, h, a0, a1, a2, a3, n0, n1, n2, n3
    load4 \n0, \n1, \n2, \n3, Y, 4*\h
    ld r0, X+
    add \n0, r0
    ld r0, X+
    adc \n1, r0
    ld r0, X+
    adc \n2, r0
    ld r0, X+
    adc \n3, r0
    lpm r0, Z+
    add \n0, r0
    lpm r0, Z+
    adc \n1, r0
    lpm r0, Z+
    adc \n2, r0
    lpm r0, Z+
    adc \n3, r0
    choose r10, 4*\f, 4*\g
    add \n0, r18
    choose r11, 4*\f+1, 4*\g+1
    adc \n1, r18
    choose r12, 4*\f+2, 4*\g+2
    adc \n2, r18
    choose r13, 4*\f+3, 4*\g+3
    adc \n3, r18
    ; rotations of e to the right by 6, 11 and 25: by 8, of those to the left by 2 and to the right by 3 and by 17
    movw r18, r10
    movw r20, r12
    movw r22, r10
    movw r24, r12
    rotate_right r18, r19, r20, r21
    rotate_right r18, r19, r20, r21
    xor4 r18, r19, r20, r21, r12, r13, r10, r11
    rotate_right r18, r19, r20, r21
    rotate_left r22, r23, r24, r25
    rotate_left r22, r23, r24, r25
    xor4 r18, r19, r20, r21, r22, r23, r24, r25
    add4 \n0, \n1, \n2, \n3, r19, r20, r21, r18
    load4 r10, r11, r12, r13, Y, 4*\d
    add4 r10, r11, r12, r13, \n0, \n1, \n2, \n3
    store4 Y, 4*\d, r10, r11, r12, r13
    ; rotations of a to the right by 2, 13 and 22: by 2; and by 16, of those to the left by 3 and by 26 (2, and 8 to the right)
    movw r18, \a0
    movw r20, \a2
    movw r22, \a0
    movw r24, \a2
    rotate_left r18, r19, r20, r21
    xor4 r18, r19, r20, r21, \a1, \a2, \a3, \a0
    rotate_left r18, r19, r20, r21
    rotate_left r18, r19, r20, r21
    rotate_right r22, r23, r24, r25
    rotate_right r22, r23, r24, r25
    xor4 r22, r23, r24, r25, r20, r21, r18, r19
    add4 \n0, \n1, \n2, \n3, r22, r23, r24, r25
    majority add, \n0, \a0, 4*\b, r14
    majority adc, \n1, \a1, 4*\b+1, r15
    majority adc, \n2, \a2, 4*\b+2, r16
    majority adc, \n3, \a3, 4*\b+3, r17
    store4 Y, 4*\h, \n0, \n1, \n2, \n3
.endm

; w[at] += w[at + 9] + sigma0(w[at + 1]) + sigma1(w[at + 14]), modulo 16, with Z at w.
.macro schedule at
    load4 r6, r7, r8, r9, Z, 4*\at
    load4 r18, r19, r20, r21, Z, 4*((\at+9)%16)
    add4 r6, r7, r8, r9, r18, r19, r20, r21
    ; rotations to the right by 7 and 18, shift by 3
    load4 r18, r19, r20, r21, Z, 4*((\at+1)%16)
    movw r22, r18
    movw r24, r20
    rotate_left r22, r23, r24, r25
    rotate_right r18, r19, r20, r21
    rotate_right r18, r19, r20, r21
    xor4 r22, r23, r24, r25, r19, r20, r21, r18
    rotate_right r18, r19, r20, r21
    andi r21, 0x1F
    xor4 r22, r23, r24, r25, r21, r18, r19, r20
    add4 r6, r7, r8, r9, r23, r24, r25, r22
    ; rotations to the right by 17 and 19, shift by 10
    load4 r18, r19, r20, r21, Z, 4*((\at+14)%16)
    rotate_right r18, r19, r20, r21
    movw r22, r18
    movw r24, r20
    rotate_right r18, r19, r20, r21
    mov r14, r19
    mov r15, r20
    mov r16, r21
    andi r16, 0x3F
    rotate_right r18, r19, r20, r21
    xor4 r22, r23, r24, r25, r18, r19, r20, r21
    eor r24, r14
    eor r25, r15
    eor r22, r16
    add4 r6, r7, r8, r9, r24, r25, r22, r23
    store4 Z, 4*\at, r6, r7, r8, r9
.endm

    .section .text.sha256_block, "ax", @progbits
    .global sha256_block
    .type sha256_block, @function
sha256_block:
    .irp register, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 28, 29
    push \register
    .endr
    push r24
    push r25
    in r28, _SFR_IO_ADDR(SPL)
    in r29, _SFR_IO_ADDR(SPH)
    subi r28, FRAME
    sbci r29, 0
    in r0, _SFR_IO_ADDR(SREG)
    cli
    out _SFR_IO_ADDR(SPH), r29
    out _SFR_IO_ADDR(SREG), r0
    out _SFR_IO_ADDR(SPL), r28
    adiw r28, 1

    movw r26, r24 ; a to h
    movw r30, r28
    ldi r18, 32
1:  ld r0, X+
    st Z+, r0
    dec r18
    brne 1b
    movw r26, r22 ; the block's words, first byte highest
    adiw r30, WORDS-32
    ldi r18, 16
2:  ld r25, X+
    ld r24, X+
    ld r23, X+
    ld r22, X+
    st Z+, r22
    st Z+, r23
    st Z+, r24
    st Z+, r25
    dec r18
    brne 2b

    load4 r2, r3, r4, r5, Y, VARIABLES
    load4 r10, r11, r12, r13, Y, VARIABLES+16
    ldi r18, 8
    std Y+EIGHTS, r18
    ldi r30, lo8(sha256_constants)
    ldi r31, hi8(sha256_constants)
.Lsixteen:
    movw r26, r28
    adiw r26, WORDS
    load4 r14, r15, r16, r17, Y, VARIABLES+4
    load4 r18, r19, r20, r21, Y, VARIABLES+8
    xor4 r14, r15, r16, r17, r18, r19, r20, r21
.Leight:
    round 1, 3, 5, 6, 7, r2, r3, r4, r5, r6, r7, r8, r9
    round 0, 2, 4, 5, 6, r6, r7, r8, r9, r2, r3, r4, r5
    round 7, 1, 3, 4, 5, r2, r3, r4, r5, r6, r7, r8, r9
    round 6, 0, 2, 3, 4, r6, r7, r8, r9, r2, r3, r4, r5
    round 5, 7, 1, 2, 3, r2, r3, r4, r5, r6, r7, r8, r9
    round 4, 6, 0, 1, 2, r6, r7, r8, r9, r2, r3, r4, r5
    round 3, 5, 7, 0, 1, r2, r3, r4, r5, r6, r7, r8, r9
    round 2, 4, 6, 7, 0, r6, r7, r8, r9, r2, r3, r4, r5
    ldd r18, Y+EIGHTS
    dec r18
    std Y+EIGHTS, r18
    brne 3f
    jmp .Lend
3:  sbrc r18, 0
    jmp .Leight
    push r30
    push r31
    movw r30, r28
    adiw r30, WORDS
    .irp at, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15
    schedule \at
    .endr
    pop r31
    pop r30
    jmp .Lsixteen

.Lend:
    movw r30, r28 ; add a to h to the state, of which the address is above the frame
    subi r30, lo8(-FRAME)
    sbci r31, hi8(-FRAME)
    ld r27, Z+
    ld r26, Z
    movw r30, r28
    ldi r18, 8
4:  ld r19, Z+
    ld r20, X
    add r20, r19
    st X+, r20
    ld r19, Z+
    ld r20, X
    adc r20, r19
    st X+, r20
    ld r19, Z+
    ld r20, X
    adc r20, r19
    st X+, r20
    ld r19, Z+
    ld r20, X
    adc r20, r19
    st X+, r20
    dec r18
    brne 4b
    subi r28, lo8(-(FRAME+1)) ; the address of the state goes, too
    sbci r29, hi8(-(FRAME+1))
    in r0, _SFR_IO_ADDR(SREG)
    cli
    out _SFR_IO_ADDR(SPH), r29
    out _SFR_IO_ADDR(SREG), r0
    out _SFR_IO_ADDR(SPL), r28
    .irp register, 29, 28, 17, 16, 15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2
    pop \register
    .endr
    ret
    .size sha256_block, . - sha256_block
