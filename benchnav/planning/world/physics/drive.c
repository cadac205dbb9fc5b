/* Robots on soil, integrated by MuJoCo.

   Each wheel is a sphere that touches a plane of its own. At each sub-step, the plane is
   laid tangent to the bilinear height map under the wheel. MuJoCo computes the loads of
   the wheels; `soil_force` computes the forces of the soil. The result depends only on
   the arguments: all memory of an episode is in `state` and `memory`. Units are SI. */
#include <math.h>
#include <mujoco/mujoco.h>
#include <string.h>
#include "wheel.h"

#define MAX_WHEELS 16
#define BROKEN 1     /* the state is not finite, or faster than anything that drives */
#define ROLLED_OVER 2
#define FASTEST 100.0
#define UPRIGHT 0.3  /* least cosine of the robot's tilt */
#define FRICTIONLESS 1e-5

#define MIN_SPEED 0.05 /* of a command that means to drive */
#define STALLED 0.1    /* achieved fraction of the speed of a robot that stands */

/* Layout of an episode's memory: numbers of the controller, then the ruts and the loads
   of the wheels. Speed and turn are the setpoint of the wheels, which follows the
   command; their means are those of the last step. Idle is the time for which the robot
   has stood under a command or, if negative, the time for which it still reverses. */
#define SPEED 0
#define TURN 1
#define INTEGRAL 2
#define IDLE 3
#define MEAN_SPEED 4
#define MEAN_TURN 5
#define RUTS 6
#define MEMORY(n_wheels) (RUTS + 2 * (n_wheels))

/* Fields of `Plant` in workspace.py, in the same order. */
typedef struct {
  int root;          /* body with the free joint */
  int n_wheels;
  int is_steered;    /* 0: command (v, ω); 1: command (v, steering angle) */
  int has_loop;      /* whether the yaw-rate loop is closed */
  int has_ruts;
  int state_size;
  const int *wheel_geom;
  const int *wheel_body;
  const int *plane_geom;
  const double *wheel_x; /* positions relative to the reference point */
  const double *wheel_y;
  const double *wheel_radius;
  double response;   /* fraction of the command that wheels make up in a sub-step */
  double turn_ratio; /* speed difference per track over ω of the robot */
  double wheelbase;
  double max_rim_speed;
  double max_steering;
  double loop_gain;
  double max_integral;
  double reverse_after; /* time of standing after which the robot reverses; 0: never */
  double reverse_for;
  double sinkage;    /* rut depth per slipped distance at λ = 0 */
  double firm_lambda;
  double healing;    /* distance in which a wheel leaves its rut */
  double rut_scale;  /* rut depth at which the resistance equals the load */
  double max_rut;
  double max_resistance;
  const double *soil;
} plant_t;

/* Height maps and slope laws. A law has a value per `law_step` degrees of slope. */
typedef struct {
  int rows;
  int columns;
  int law_size;
  double resolution;
  double law_step;
  const double *height; /* [B, rows, columns] */
  const double *law;    /* [classes, law_size] */
} terrain_t;

/* Numbers of a wheel's cell. */
typedef struct {
  double lambda;
  double slope_deg;
  double class_index; /* of the slope law; negative for none */
} cell_t;

static double height_at(const terrain_t *terrain, const double *height, double x,
                        double y, double gradient[2]) {
  double column = x / terrain->resolution - 0.5;
  double row = y / terrain->resolution - 0.5;
  column = fmin(fmax(column, 0), terrain->columns - 1 - 1e-9);
  row = fmin(fmax(row, 0), terrain->rows - 1 - 1e-9);
  int j = (int)column, i = (int)row;
  double a = column - j, b = row - i;
  const double *low = height + i * terrain->columns + j;
  const double *high = low + terrain->columns;
  gradient[0] = ((1 - b) * (low[1] - low[0]) + b * (high[1] - high[0]));
  gradient[1] = ((1 - a) * (high[0] - low[0]) + a * (high[1] - low[1]));
  gradient[0] /= terrain->resolution;
  gradient[1] /= terrain->resolution;
  return (1 - b) * ((1 - a) * low[0] + a * low[1]) +
         b * ((1 - a) * high[0] + a * high[1]);
}

static double law_at(const terrain_t *terrain, const double *law, double slope_deg) {
  double place = fmin(slope_deg / terrain->law_step, terrain->law_size - 1 - 1e-9);
  int i = (int)place;
  double a = place - i;
  return (1 - a) * law[i] + a * law[i + 1];
}

static double slope_gain(const terrain_t *terrain, const cell_t *cell, double cosine) {
  if (cell->class_index < 0 || !terrain->law) return 0;
  const double *law = terrain->law + (int)cell->class_index * terrain->law_size;
  double uphill_deg = cell->slope_deg * fmax(cosine, 0);
  return law_at(terrain, law, uphill_deg) - law_at(terrain, law, cell->slope_deg);
}

static double dot(const double *a, const double *b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static void cross(double *result, const double *a, const double *b) {
  result[0] = a[1] * b[2] - a[2] * b[1];
  result[1] = a[2] * b[0] - a[0] * b[2];
  result[2] = a[0] * b[1] - a[1] * b[0];
}

static void normal_of(const double gradient[2], double normal[3]) {
  double length = sqrt(1 + gradient[0] * gradient[0] + gradient[1] * gradient[1]);
  normal[0] = -gradient[0] / length;
  normal[1] = -gradient[1] / length;
  normal[2] = 1 / length;
}

/* Lays the planes under the wheels; sets contact points, normals and gradients. */
static void lay_planes(const mjModel *m, mjData *d, const plant_t *plant,
                       const terrain_t *terrain, const double *height,
                       double point[][3], double normal[][3], double gradient[][2]) {
  for (int k = 0; k < plant->n_wheels; k++) {
    const double *centre = d->geom_xpos + 3 * plant->wheel_geom[k];
    double radius = plant->wheel_radius[k];
    double *n = normal[k], *p = point[k], *g = gradient[k];
    /* Estimate the contact from the terrain under the centre, then lay the plane. */
    height_at(terrain, height, centre[0], centre[1], g);
    normal_of(g, n);
    double x = centre[0] - radius * n[0];
    double y = centre[1] - radius * n[1];
    double z = height_at(terrain, height, x, y, g);
    normal_of(g, n);
    for (int a = 0; a < 3; a++) p[a] = centre[a] - radius * n[a];
    int mocap = m->body_mocapid[m->geom_bodyid[plant->plane_geom[k]]];
    double *position = d->mocap_pos + 3 * mocap;
    double *rotation = d->mocap_quat + 4 * mocap;
    position[0] = x;
    position[1] = y;
    position[2] = z;
    double scale = 1 / sqrt(2 + 2 * n[2]);
    rotation[0] = (1 + n[2]) * scale;
    rotation[1] = -n[1] * scale;
    rotation[2] = n[0] * scale;
    rotation[3] = 0;
  }
}

/* Sets rim speeds and steering angles of the wheels from the command. */
static void control(const mjModel *m, const mjData *d, const plant_t *plant,
                    const double command[2], double *memory, double *rim_speed,
                    double *steering) {
  const double *axes = d->xmat + 9 * plant->root;
  double heading[3] = {axes[0], axes[3], axes[6]};
  double along = dot(heading, d->qvel);
  double yaw_rate = d->qvel[5];
  double time_step = m->opt.timestep;
  double wanted_speed = command[0], wanted_turn = command[1];
  if (plant->reverse_after > 0) {
    int is_reversing = memory[IDLE] < 0;
    int is_driven = fabs(wanted_speed) > MIN_SPEED;
    if (is_reversing) {
      wanted_speed = -wanted_speed;
      wanted_turn = 0;
      memory[IDLE] = fmin(memory[IDLE] + time_step, 0);
    } else if (is_driven && fabs(along) < STALLED * fabs(wanted_speed)) {
      memory[IDLE] += time_step;
      if (memory[IDLE] >= plant->reverse_after) memory[IDLE] = -plant->reverse_for;
    } else {
      memory[IDLE] = 0;
    }
  }
  memory[SPEED] += plant->response * (wanted_speed - memory[SPEED]);
  memory[TURN] += plant->response * (wanted_turn - memory[TURN]);
  memory[MEAN_SPEED] += memory[SPEED];
  memory[MEAN_TURN] += memory[TURN];
  double speed = memory[SPEED], turn = memory[TURN];
  double wanted = turn;
  if (plant->is_steered) wanted = speed * tan(turn) / plant->wheelbase;
  if (plant->has_loop && fabs(speed) > MIN_SPEED) {
    /* Hold the commanded curvature: soft terrain slows the turn as it slows the way. */
    double ratio = fmin(fmax(along / speed, 0.1), 1);
    double error = wanted * ratio - yaw_rate;
    double scale = 1;
    if (plant->is_steered) {
      scale = plant->wheelbase / fmax(fabs(speed) * ratio, 0.1);
      if (speed < 0) scale = -scale;
    }
    double integral = memory[INTEGRAL] + time_step * plant->loop_gain * error * scale;
    double bound = plant->max_integral;
    memory[INTEGRAL] = fmin(fmax(integral, -bound), bound);
  } else {
    memory[INTEGRAL] *= fmax(1 - time_step * plant->loop_gain, 0);
  }
  double fastest = plant->max_rim_speed;
  if (!plant->is_steered) {
    double difference = plant->turn_ratio * turn + memory[INTEGRAL];
    for (int k = 0; k < plant->n_wheels; k++) {
      double rim = speed - plant->wheel_y[k] * difference;
      rim_speed[k] = fmin(fmax(rim, -fastest), fastest);
      steering[k] = 0;
    }
    return;
  }
  double angle = turn + memory[INTEGRAL];
  angle = fmin(fmax(angle, -plant->max_steering), plant->max_steering);
  double curvature = tan(angle) / plant->wheelbase;
  for (int k = 0; k < plant->n_wheels; k++) {
    double x = curvature * plant->wheel_x[k];
    double y = 1 - curvature * plant->wheel_y[k];
    double rim = speed * sqrt(x * x + y * y);
    rim_speed[k] = fmin(fmax(rim, -fastest), fastest);
    steering[k] = atan2(x, y);
  }
}

static void apply_wheel(const mjModel *m, mjData *d, const plant_t *plant,
                        const terrain_t *terrain, const cell_t *cell, int k,
                        double rim_speed, double steering, const double *point,
                        const double *n, const double *gradient, double load,
                        double *rut) {
  int body = plant->wheel_body[k];
  const double *axes = d->xmat + 9 * body;
  double c = cos(steering), s = sin(steering);
  double ahead[3], left[3], level[3];
  for (int a = 0; a < 3; a++) level[a] = c * axes[3 * a] + s * axes[3 * a + 1];
  double out = dot(level, n);
  for (int a = 0; a < 3; a++) ahead[a] = level[a] - out * n[a];
  double length = sqrt(dot(ahead, ahead));
  if (length < 1e-6) return; /* the robot stands on its nose */
  for (int a = 0; a < 3; a++) ahead[a] /= length;
  cross(left, n, ahead);
  double motion[6], arm[3], velocity[3];
  mj_objectVelocity(m, d, mjOBJ_XBODY, body, motion, 0);
  for (int a = 0; a < 3; a++) arm[a] = point[a] - d->xpos[3 * body + a];
  cross(velocity, motion, arm);
  for (int a = 0; a < 3; a++) velocity[a] += motion[3 + a];
  wheel_t wheel;
  /* Commands are speeds in the plane of the map, as λ is. */
  double level_length = sqrt(ahead[0] * ahead[0] + ahead[1] * ahead[1]);
  wheel.rim_speed = rim_speed / fmax(level_length, 0.1);
  wheel.along = dot(velocity, ahead);
  wheel.across = dot(velocity, left);
  wheel.load = load;
  wheel.lambda = cell->lambda;
  wheel.slope = tan(cell->slope_deg * mjPI / 180);
  wheel.climb = ahead[2] / n[2];
  wheel.tilt = left[2] / n[2];
  double steepness = sqrt(gradient[0] * gradient[0] + gradient[1] * gradient[1]);
  double cosine = gradient[0] * ahead[0] + gradient[1] * ahead[1];
  cosine /= steepness * level_length + 1e-12;
  if (rim_speed < 0) cosine = -cosine;
  wheel.slope_gain = slope_gain(terrain, cell, cosine);
  if (plant->has_ruts) {
    double softness = fmax(1 - cell->lambda / plant->firm_lambda, 0);
    double slipped = fabs(wheel.rim_speed - wheel.along);
    double moved = sqrt(wheel.along * wheel.along + wheel.across * wheel.across);
    double deeper = plant->sinkage * softness * slipped - *rut * moved / plant->healing;
    *rut = fmin(fmax(*rut + m->opt.timestep * deeper, 0), plant->max_rut);
  }
  if (load <= 0) return;
  double tangential[2], force[3], no_torque[3] = {0, 0, 0};
  soil_force(&wheel, plant->soil, tangential);
  for (int a = 0; a < 3; a++) {
    force[a] = tangential[0] * ahead[a] + tangential[1] * left[a];
  }
  mj_applyFT(m, d, force, no_torque, point, body, d->qfrc_applied);
}

static int is_broken(const mjModel *m, const mjData *d) {
  for (int i = 0; i < m->nq; i++) {
    if (!isfinite(d->qpos[i])) return 1;
  }
  for (int i = 0; i < m->nv; i++) {
    if (!(fabs(d->qvel[i]) <= FASTEST)) return 1;
  }
  return 0;
}

static int sub_step(mjModel *m, mjData *d, const plant_t *plant,
                    const terrain_t *terrain, const double *height,
                    const cell_t *cells, const double command[2], double *memory) {
  double point[MAX_WHEELS][3], normal[MAX_WHEELS][3], gradient[MAX_WHEELS][2];
  double rim_speed[MAX_WHEELS], steering[MAX_WHEELS];
  double *ruts = memory + RUTS;
  double *loads = ruts + plant->n_wheels;
  mj_kinematics(m, d);
  lay_planes(m, d, plant, terrain, height, point, normal, gradient);
  for (int k = 0; k < plant->n_wheels; k++) {
    double depth = ruts[k] / plant->rut_scale;
    double resistance = fmin(depth * depth, plant->max_resistance);
    int is_held = plant->has_ruts && resistance > 1e-3;
    /* Without friction, a contact has one constraint instead of three. */
    m->geom_condim[plant->plane_geom[k]] = is_held ? 3 : 1;
    m->geom_friction[3 * plant->plane_geom[k]] = is_held ? resistance : FRICTIONLESS;
  }
  mj_fwdPosition(m, d);
  mj_fwdVelocity(m, d);
  control(m, d, plant, command, memory, rim_speed, steering);
  memset(d->qfrc_applied, 0, m->nv * sizeof(mjtNum));
  for (int k = 0; k < plant->n_wheels; k++) {
    apply_wheel(m, d, plant, terrain, cells + k, k, rim_speed[k], steering[k],
                point[k], normal[k], gradient[k], loads[k], ruts + k);
  }
  mj_fwdActuation(m, d);
  mj_fwdAcceleration(m, d);
  mj_fwdConstraint(m, d);
  for (int k = 0; k < plant->n_wheels; k++) loads[k] = 0;
  for (int j = 0; j < d->ncon; j++) {
    const mjContact *contact = d->contact + j;
    if (contact->efc_address < 0) continue;
    for (int k = 0; k < plant->n_wheels; k++) {
      int plane = plant->plane_geom[k];
      if (contact->geom[0] != plane && contact->geom[1] != plane) continue;
      loads[k] += d->efc_force[contact->efc_address];
    }
  }
  mj_Euler(m, d);
  return is_broken(m, d) ? BROKEN : 0;
}

#define SAVED (mjSTATE_FULLPHYSICS | mjSTATE_WARMSTART)

int state_size(const mjModel *m) { return mj_stateSize(m, SAVED); }

/* Writes x, y, yaw, and the contact points of the wheels. */
static void write_pose(const mjModel *m, mjData *d, const plant_t *plant,
                       const terrain_t *terrain, const double *height, double *pose,
                       double *contacts) {
  double point[MAX_WHEELS][3], normal[MAX_WHEELS][3], gradient[MAX_WHEELS][2];
  mj_kinematics(m, d);
  lay_planes(m, d, plant, terrain, height, point, normal, gradient);
  const double *axes = d->xmat + 9 * plant->root;
  pose[0] = d->qpos[0];
  pose[1] = d->qpos[1];
  pose[2] = atan2(axes[3], axes[0]);
  for (int k = 0; k < plant->n_wheels; k++) {
    contacts[2 * k] = point[k][0];
    contacts[2 * k + 1] = point[k][1];
  }
}

/* Advances some of B episodes by `n_sub_steps`, in place.

   episodes: indices of the episodes, [n_episodes].
   state: state of MuJoCo, [B, state_size].  memory: [B, MEMORY(n_wheels)].
   command: [B, 2].  cells: [B, n_wheels].  pose: result, [B, 3].
   contacts: result, [B, 2 n_wheels].  status: result, [B]. */
void advance(mjModel *m, mjData *d, const plant_t *plant, const terrain_t *terrain,
             int n_episodes, const int *episodes, int n_sub_steps, double *state,
             double *memory, const double *command, const cell_t *cells, double *pose,
             double *contacts, int *status) {
  int n = plant->n_wheels;
  for (int e = 0; e < n_episodes; e++) {
    int i = episodes[e];
    double *own_state = state + (long)i * plant->state_size;
    double *own_memory = memory + (long)i * MEMORY(n);
    const double *height = terrain->height + (long)i * terrain->rows * terrain->columns;
    double before[MEMORY(MAX_WHEELS)];
    memcpy(before, own_memory, MEMORY(n) * sizeof(double));
    mj_resetData(m, d);
    mj_setState(m, d, own_state, SAVED);
    own_memory[MEAN_SPEED] = own_memory[MEAN_TURN] = 0;
    int result = 0;
    for (int s = 0; s < n_sub_steps && !result; s++) {
      result = sub_step(m, d, plant, terrain, height, cells + i * n, command + 2 * i,
                        own_memory);
    }
    own_memory[MEAN_SPEED] /= n_sub_steps;
    own_memory[MEAN_TURN] /= n_sub_steps;
    if (result == BROKEN) {
      /* Keep the last state that is sound. */
      memcpy(own_memory, before, MEMORY(n) * sizeof(double));
      mj_resetData(m, d);
      mj_setState(m, d, own_state, SAVED);
    }
    d->time = 0;
    mj_getState(m, d, own_state, SAVED);
    write_pose(m, d, plant, terrain, height, pose + 3 * i, contacts + 2 * i * n);
    if (!result && d->xmat[9 * plant->root + 8] < UPRIGHT) result = ROLLED_OVER;
    status[i] = result;
  }
}

/* Puts robots at poses (x, y, yaw), lets them sink onto the terrain, and stops them.

   The height of the root is chosen so that no wheel is below the terrain. If `is_free`
   is 0, x and y are held while the robot settles. */
void place(mjModel *m, mjData *d, const plant_t *plant, const terrain_t *terrain,
           int n_episodes, int n_sub_steps, int is_free, const double *start,
           const cell_t *cells, double *state, double *memory, double *pose,
           double *contacts, int *status) {
  int n = plant->n_wheels;
  double no_command[2] = {0, 0};
  for (int i = 0; i < n_episodes; i++) {
    const double *height = terrain->height + (long)i * terrain->rows * terrain->columns;
    double *own_memory = memory + (long)i * MEMORY(n);
    double x = start[3 * i], y = start[3 * i + 1], yaw = start[3 * i + 2];
    memset(own_memory, 0, MEMORY(n) * sizeof(double));
    mj_resetData(m, d);
    double g[2], up[3], left[3], ahead[3] = {cos(yaw), sin(yaw), 0};
    height_at(terrain, height, x, y, g);
    normal_of(g, up);
    ahead[2] = g[0] * ahead[0] + g[1] * ahead[1];
    double length = sqrt(dot(ahead, ahead));
    for (int a = 0; a < 3; a++) ahead[a] /= length;
    cross(left, up, ahead);
    double axes[9];
    for (int a = 0; a < 3; a++) {
      axes[3 * a] = ahead[a];
      axes[3 * a + 1] = left[a];
      axes[3 * a + 2] = up[a];
    }
    mju_mat2Quat(d->qpos + 3, axes);
    d->qpos[0] = x;
    d->qpos[1] = y;
    d->qpos[2] = 0;
    mj_kinematics(m, d);
    double lift = -1e9;
    for (int k = 0; k < n; k++) {
      const double *centre = d->geom_xpos + 3 * plant->wheel_geom[k];
      double z = height_at(terrain, height, centre[0], centre[1], g);
      double slant = sqrt(1 + g[0] * g[0] + g[1] * g[1]);
      lift = fmax(lift, z + plant->wheel_radius[k] * slant - centre[2]);
    }
    d->qpos[2] = lift + 1e-3;
    int result = 0;
    for (int s = 0; s < n_sub_steps && !result; s++) {
      result = sub_step(m, d, plant, terrain, height, cells + i * n, no_command,
                        own_memory);
      if (is_free) continue;
      d->qpos[0] = x;
      d->qpos[1] = y;
      d->qvel[0] = d->qvel[1] = 0;
    }
    if (!is_free) memset(d->qvel, 0, m->nv * sizeof(mjtNum));
    d->time = 0;
    mj_getState(m, d, state + (long)i * plant->state_size, SAVED);
    write_pose(m, d, plant, terrain, height, pose + 3 * i, contacts + 2 * i * n);
    if (!result && d->xmat[9 * plant->root + 8] < UPRIGHT) result = ROLLED_OVER;
    status[i] = result;
  }
}

/* Computes the forces of the soil on N wheels, for comparison with the oracle. */
void soil_forces(int n_wheels, const wheel_t *wheels, const double *soil,
                 double *forces) {
  for (int k = 0; k < n_wheels; k++) soil_force(wheels + k, soil, forces + 2 * k);
}
