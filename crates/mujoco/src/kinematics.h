#ifndef PERTURB_MUJOCO_KINEMATICS_H_
#define PERTURB_MUJOCO_KINEMATICS_H_

#include <mujoco/mujoco.h>

// What mj_kinematics, mj_comPos and mj_comVel compute, to the same bytes. They are a quarter of a robot's timestep, most of
// which are calls through the library's table for a few multiplications each. So chains of hinges and slides are walked
// here, and all other models by MuJoCo.
void perturb_kinematics(const mjModel* model, mjData* data);
void perturb_com_pos(const mjModel* model, mjData* data);
void perturb_com_vel(const mjModel* model, mjData* data);

#endif  // PERTURB_MUJOCO_KINEMATICS_H_
