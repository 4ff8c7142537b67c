/* What the rod must do so that the crane tip stays where it is while the vessel heaves: a sum of sines, the same every time.
 *
 * Spectrum: JONSWAP (DNV-RP-C205, peak factor 3.3), vessel heave as of a box hull in beam sea
 * exp(-kT) |sin(kB/2) / (kB/2)|, k = w^2 / g, divided by the crane's lever (tip metres per rod metre).
 * No heap, no globals; init needs exp, log, pow and sqrt, evaluate needs sin and cos of each component. */
#ifndef WAVE_H
#define WAVE_H

#define WAVE_COMPONENT_COUNT 12

typedef struct {
    double significant_height_m; /* Hs, four standard deviations of the sea */
    double peak_period_s;        /* Tp */
    double lever;                /* tip metres per rod metre */
} wave_sea_t;

typedef struct {
    double amplitude_m[WAVE_COMPONENT_COUNT]; /* at the rod */
    double omega_radps[WAVE_COMPONENT_COUNT];
    double phase_rad[WAVE_COMPONENT_COUNT];
} wave_t;

/* Frequencies lie unevenly, so the sum does not repeat; phases grow with the square of the index, so it has no freak peak. */
void wave_init(wave_t *wave, const wave_sea_t *sea);

/* Rod position and velocity around the middle position, at a time since the start. */
void wave_evaluate(const wave_t *wave, double time_s, double *position_m, double *velocity_mps);

#endif
