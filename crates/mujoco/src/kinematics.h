#ifndef PERTURB_MUJOCO_KINEMATICS_H_
#define PERTURB_MUJOCO_KINEMATICS_H_

#include <mujoco/mujoco.h>

// These functions compute the same bytes as mj_kinematics, mj_comPos and mj_comVel of a MuJoCo library that was
// compiled without fused multiply-add. They are faster: MuJoCo's functions take a quarter of a robot's timestep, mostly
// for calls of tiny library functions. Models with other joints than hinges and slides, with sites or with mocap bodies
// are passed to MuJoCo's functions. Unlike mj_comPos, perturb_com_pos does not use the stack of `data`.
void perturb_kinematics(const mjModel* model, mjData* data);
void perturb_com_pos(const mjModel* model, mjData* data);
void perturb_com_vel(const mjModel* model, mjData* data);

#endif  // PERTURB_MUJOCO_KINEMATICS_H_
