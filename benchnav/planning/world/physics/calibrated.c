/* Soil on which a wheel moves at λ times the speed of its rim.

   The force pulls the contact to that velocity with at most the grip. The component of
   gravity along the terrain is carried in addition, since λ already contains the effect
   of the slope. Friction bounds the sum. Parameters: friction, speed scale of the grip
   in m/s, least λ of the grip (1 for a constant grip), whether λ depends on the heading.
   The oracle in Python is `Calibrated.force`. */
#include <math.h>
#include "wheel.h"

void soil_force(const wheel_t *wheel, const double *parameters, double force[2]) {
  double friction = parameters[0];
  double speed_scale = parameters[1];
  double least_grip = parameters[2];
  double lambda = wheel->lambda;
  if (parameters[3] != 0) lambda += wheel->slope_gain;
  lambda = fmin(fmax(lambda, 0), 1);
  double error_along = lambda * wheel->rim_speed - wheel->along;
  double error_across = -wheel->across;
  double error = sqrt(error_along * error_along + error_across * error_across);
  double grip = friction * fmax(lambda, least_grip);
  double gain = grip / speed_scale;
  if (error > 1e-9) gain = grip * tanh(error / speed_scale) / error;
  double along = gain * error_along + wheel->climb;
  double across = gain * error_across + wheel->tilt;
  double total = sqrt(along * along + across * across);
  double scale = wheel->load;
  if (total > friction) scale *= friction / total;
  force[0] = scale * along;
  force[1] = scale * across;
}
