#include "wave.h"

#include <math.h>

#define PI 3.14159265358979323846
#define GRAVITY_MPS2 9.81
#define GOLDEN_FRACTION 0.6180339887498949
#define OMEGA_LOW_RADPS 0.45
#define OMEGA_HIGH_RADPS 1.75
#define PEAK_FACTOR 3.3
#define HULL_BREADTH_M 18.0
#define HULL_DRAUGHT_M 5.0

/* m^2 s */
static double sea_spectrum(const wave_sea_t *sea, double omega)
{
    double peak = 2.0 * PI / sea->peak_period_s;
    double width = omega <= peak ? 0.07 : 0.09;
    double distance = (omega - peak) / (width * peak);
    double shape = 5.0 / 16.0 * pow(sea->significant_height_m, 2.0) * pow(peak, 4.0) * pow(omega, -5.0)
        * exp(-1.25 * pow(omega / peak, -4.0));
    return (1.0 - 0.287 * log(PEAK_FACTOR)) * shape * pow(PEAK_FACTOR, exp(-0.5 * distance * distance));
}

/* metres of heave per metre of wave */
static double heave_response(double omega)
{
    double wave_number = omega * omega / GRAVITY_MPS2;
    double half = 0.5 * wave_number * HULL_BREADTH_M;
    return exp(-wave_number * HULL_DRAUGHT_M) * fabs(sin(half) / half);
}

void wave_init(wave_t *wave, const wave_sea_t *sea)
{
    double bin = (OMEGA_HIGH_RADPS - OMEGA_LOW_RADPS) / WAVE_COMPONENT_COUNT;
    for (int index = 0; index < WAVE_COMPONENT_COUNT; index++) {
        double within = fmod(0.5 + index * GOLDEN_FRACTION, 1.0);
        double omega = OMEGA_LOW_RADPS + bin * (index + 0.25 + 0.5 * within);
        wave->omega_radps[index] = omega;
        wave->amplitude_m[index] = sqrt(2.0 * sea_spectrum(sea, omega) * bin) * heave_response(omega) / sea->lever;
        wave->phase_rad[index] = 2.0 * PI * fmod((double)(index * index) * GOLDEN_FRACTION, 1.0);
    }
}

void wave_evaluate(const wave_t *wave, double time_s, double *position_m, double *velocity_mps)
{
    double position = 0.0;
    double velocity = 0.0;
    for (int index = 0; index < WAVE_COMPONENT_COUNT; index++) {
        double angle = wave->omega_radps[index] * time_s + wave->phase_rad[index];
        position += wave->amplitude_m[index] * sin(angle);
        velocity += wave->amplitude_m[index] * wave->omega_radps[index] * cos(angle);
    }
    *position_m = position;
    *velocity_mps = velocity;
}
