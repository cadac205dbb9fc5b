/* A wheel on soil. A soil law is a C file that includes this header and defines
   `soil_force`. Units are SI. */
#ifndef BENCHNAV_WHEEL_H
#define BENCHNAV_WHEEL_H

typedef struct {
  double rim_speed;  /* speed of the rim along the wheel's heading, m/s */
  double along;      /* velocity of the contact along the heading, m/s */
  double across;     /* velocity of the contact to the left, m/s */
  double load;       /* normal force, N */
  double lambda;     /* traversability of the cell */
  double slope_gain; /* what the class's slope law adds to it in this direction */
  double slope;      /* tangent of the inclination of the cell */
  double climb;      /* tangent of the terrain's inclination along the heading */
  double tilt;       /* tangent of the terrain's inclination to the left */
} wheel_t;

/* Computes the tangential force of the soil on a wheel.

   parameters: numbers that the soil's Python value states.
   force: result, along the heading and to the left, in N. */
void soil_force(const wheel_t *wheel, const double *parameters, double force[2]);

#endif
