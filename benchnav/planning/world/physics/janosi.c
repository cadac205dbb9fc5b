/* Soil that shears: Janosi and Hanamoto (1961), "The analytical determination of drawbar
   pull as a function of slip for tracked vehicles in deformable soils".

   Traction per load is m (1 - exp(-s / k)) with slip s, less the resistance r. The
   displacement k of each cell follows from λ: a wheel that drives straight up the cell's
   slope has slip 1 - λ. Where the soil cannot carry that slope, its traction is raised
   until it does by `reserve`. Parameters: m, r, reserve, speed scale of the resistance
   and least speed of the slip in m/s. The oracle in Python is `Janosi.force`. */
#include <math.h>
#include "wheel.h"

void soil_force(const wheel_t *wheel, const double *parameters, double force[2]) {
  double resistance = parameters[1];
  double reserve = parameters[2];
  double speed_scale = parameters[3];
  double least_speed = parameters[4];
  double needed = fmax(wheel->slope, 0) + resistance;
  double traction = fmax(parameters[0], reserve * needed);
  double slip_uphill = fmax(1 - wheel->lambda, 0.02);
  double displacement = slip_uphill / -log(1 - needed / traction);
  double speed = fmax(fmax(fabs(wheel->rim_speed), fabs(wheel->along)), least_speed);
  double slip_along = (wheel->rim_speed - wheel->along) / speed;
  double slip_across = -wheel->across / speed;
  double slip = sqrt(slip_along * slip_along + slip_across * slip_across);
  double gain = traction / displacement;
  if (slip > 1e-9) gain = traction * (1 - exp(-slip / displacement)) / slip;
  double drag = resistance * tanh(wheel->along / speed_scale);
  force[0] = wheel->load * (gain * slip_along - drag);
  force[1] = wheel->load * gain * slip_across;
}
