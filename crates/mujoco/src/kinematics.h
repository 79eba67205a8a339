#ifndef PERTURB_MUJOCO_KINEMATICS_H_
#define PERTURB_MUJOCO_KINEMATICS_H_

#include <mujoco/mujoco.h>

// What mj_kinematics, mj_comPos and mj_comVel compute, to the same bytes as a library that fuses no products and sums.
// They are a quarter of a robot's timestep, most of which are calls through the library's table for a few
// multiplications each. So trees of hinges and slides, without sites and mocap bodies, are walked here, and all other
// models by MuJoCo. The stack of `data`, which mj_comPos uses, is left alone.
void perturb_kinematics(const mjModel* model, mjData* data);
void perturb_com_pos(const mjModel* model, mjData* data);
void perturb_com_vel(const mjModel* model, mjData* data);

#endif  // PERTURB_MUJOCO_KINEMATICS_H_
