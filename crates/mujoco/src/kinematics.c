// Forward kinematics of hinges and slides. The order of floating-point operations is MuJoCo's, so the results have the
// same bytes. If MuJoCo skips a rotation by the identity, this code also skips it, because a rotation could change the
// sign of a zero.
//
// Shapes: vectors [3], quaternions [4] with w first, matrices [3, 3] row-major, motions [6] with rotation first.
#include "kinematics.h"

#include <math.h>
#include <string.h>

#ifdef __x86_64__

// Maximal number of bodies for which perturb_com_pos computes centres of mass. It leaves larger models to MuJoCo.
enum { MOST_BODIES = 32 };

static inline int is_identity(const mjtNum* q) { return q[0] == 1 && q[1] == 0 && q[2] == 0 && q[3] == 0; }

static inline void copy3(mjtNum* to, const mjtNum* from) { memcpy(to, from, 3 * sizeof(mjtNum)); }

static inline void add3(mjtNum* to, const mjtNum* a, const mjtNum* b) {
  for (int i = 0; i < 3; i++) to[i] = a[i] + b[i];
}

static inline void subtract3(mjtNum* to, const mjtNum* a, const mjtNum* b) {
  for (int i = 0; i < 3; i++) to[i] = a[i] - b[i];
}

// Cross product of `a` and `b`. `to` must be neither `a` nor `b`.
static inline void cross(mjtNum* to, const mjtNum* a, const mjtNum* b) {
  to[0] = a[1] * b[2] - a[2] * b[1];
  to[1] = a[2] * b[0] - a[0] * b[2];
  to[2] = a[0] * b[1] - a[1] * b[0];
}

// Product of the matrix `m` and the vector `v`. `to` must not be `v`.
static inline void by_matrix(mjtNum* to, const mjtNum* v, const mjtNum* m) {
  for (int i = 0; i < 3; i++) to[i] = m[3 * i] * v[0] + m[3 * i + 1] * v[1] + m[3 * i + 2] * v[2];
}

// Rotates `v` by the quaternion `q`. `to` must not be `v`.
static inline void by_quaternion(mjtNum* to, const mjtNum* v, const mjtNum* q) {
  if (is_identity(q)) {
    copy3(to, v);
    return;
  }
  mjtNum x = q[0] * v[0] + q[2] * v[2] - q[3] * v[1];
  mjtNum y = q[0] * v[1] + q[3] * v[0] - q[1] * v[2];
  mjtNum z = q[0] * v[2] + q[1] * v[1] - q[2] * v[0];
  to[0] = v[0] + 2 * (q[2] * z - q[3] * y);
  to[1] = v[1] + 2 * (q[3] * x - q[1] * z);
  to[2] = v[2] + 2 * (q[1] * y - q[2] * x);
}

// Product of the quaternions `a` and `b`. `to` must be neither `a` nor `b`.
static inline void product(mjtNum* to, const mjtNum* a, const mjtNum* b) {
  to[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
  to[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
  to[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1];
  to[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0];
}

// Sets `q` to the quaternion of a rotation about a unit axis, by `angle` in rad.
static inline void about(mjtNum* q, const mjtNum* axis, mjtNum angle) {
  mjtNum half = angle * 0.5, s = sin(half);
  q[0] = cos(half);
  for (int i = 0; i < 3; i++) q[i + 1] = angle == 0 ? 0 : axis[i] * s;
}

static inline void normalise(mjtNum* q) {
  mjtNum norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  mjtNum inverse = 1 / norm;
  for (int i = 0; i < 4; i++) q[i] = norm < mjMINVAL ? i == 0 : q[i] * inverse;
}

// Sets `m` to the rotation matrix of the quaternion `q`.
static inline void matrix(mjtNum* m, const mjtNum* q) {
  if (is_identity(q)) {
    for (int i = 0; i < 9; i++) m[i] = i % 4 == 0;
    return;
  }
  mjtNum ww = q[0] * q[0], wx = q[0] * q[1], wy = q[0] * q[2], wz = q[0] * q[3], xx = q[1] * q[1];
  mjtNum xy = q[1] * q[2], xz = q[1] * q[3], yy = q[2] * q[2], yz = q[2] * q[3], zz = q[3] * q[3];
  m[0] = ww + xx - yy - zz;
  m[1] = 2 * (xy - wz);
  m[2] = 2 * (xz + wy);
  m[3] = 2 * (xy + wz);
  m[4] = ww - xx + yy - zz;
  m[5] = 2 * (yz - wx);
  m[6] = 2 * (xz - wy);
  m[7] = 2 * (yz + wx);
  m[8] = ww - xx - yy + zz;
}

// Moves a body's position and orientation by the displacement of one of its joints. Stores the joint's anchor and axis.
static inline void move(const mjModel* m, mjData* d, int joint, mjtNum* position, mjtNum* orientation) {
  mjtNum* anchor = d->xanchor + 3 * joint;
  mjtNum* axis = d->xaxis + 3 * joint;
  mjtNum at[3], turn[4], turned[4], back[3];
  by_quaternion(axis, m->jnt_axis + 3 * joint, orientation);
  by_quaternion(at, m->jnt_pos + 3 * joint, orientation);
  add3(anchor, at, position);
  int place = m->jnt_qposadr[joint];
  mjtNum by = d->qpos[place] - m->qpos0[place];
  if (m->jnt_type[joint] == mjJNT_SLIDE) {
    for (int i = 0; i < 3; i++) position[i] += axis[i] * by;
    return;
  }
  about(turn, m->jnt_axis + 3 * joint, by);
  product(turned, orientation, turn);
  memcpy(orientation, turned, sizeof turned);
  by_quaternion(back, m->jnt_pos + 3 * joint, orientation);
  for (int i = 0; i < 3; i++) position[i] += (anchor[i] - position[i]) - back[i];
}

// Computes the world pose of an element that is fixed to a body, from its pose in the body's frame. `same` is MuJoCo's
// `sameframe`: 0 if the element has a frame of its own, 1 if it has the body's frame, otherwise it has the body's
// inertial frame.
static inline void attach(const mjData* d, int body, mjtByte same, const mjtNum* position, const mjtNum* orientation,
                          mjtNum* to, mjtNum* rotation) {
  if (same) {
    copy3(to, (same == 1 ? d->xpos : d->xipos) + 3 * body);
    memcpy(rotation, (same == 1 ? d->xmat : d->ximat) + 9 * body, 9 * sizeof(mjtNum));
    return;
  }
  mjtNum turned[4];
  by_matrix(to, position, d->xmat + 9 * body);
  add3(to, to, d->xpos + 3 * body);
  product(turned, d->xquat + 4 * body, orientation);
  matrix(rotation, turned);
}

// Returns whether this file can compute the kinematics of the model. Other models are left to MuJoCo.
static int is_walked(const mjModel* m) {
  if (m->nsite || m->nmocap) return 0;
  for (int joint = 0; joint < m->njnt; joint++) {
    if (m->jnt_type[joint] != mjJNT_HINGE && m->jnt_type[joint] != mjJNT_SLIDE) return 0;
  }
  return 1;
}

void perturb_kinematics(const mjModel* m, mjData* d) {
  if (!is_walked(m)) {
    mj_kinematics(m, d);
    return;
  }
  static const mjtNum unit[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  memset(d->xpos, 0, 3 * sizeof(mjtNum));
  memset(d->xipos, 0, 3 * sizeof(mjtNum));
  memcpy(d->xquat, unit, 4 * sizeof(mjtNum));
  memcpy(d->xmat, unit, sizeof unit);
  memcpy(d->ximat, unit, sizeof unit);
  for (int body = 1; body < m->nbody; body++) {
    int parent = m->body_parentid[body];
    mjtNum offset[3], position[3], orientation[4];
    by_matrix(offset, m->body_pos + 3 * body, d->xmat + 9 * parent);
    add3(position, d->xpos + 3 * parent, offset);
    product(orientation, d->xquat + 4 * parent, m->body_quat + 4 * body);
    for (int j = 0; j < m->body_jntnum[body]; j++) move(m, d, m->body_jntadr[body] + j, position, orientation);
    normalise(orientation);
    copy3(d->xpos + 3 * body, position);
    memcpy(d->xquat + 4 * body, orientation, sizeof orientation);
    matrix(d->xmat + 9 * body, orientation);
    attach(d, body, m->body_sameframe[body], m->body_ipos + 3 * body, m->body_iquat + 4 * body, d->xipos + 3 * body,
           d->ximat + 9 * body);
  }
  for (int geom = 0; geom < m->ngeom; geom++) {
    attach(d, m->geom_bodyid[geom], m->geom_sameframe[geom], m->geom_pos + 3 * geom, m->geom_quat + 4 * geom,
           d->geom_xpos + 3 * geom, d->geom_xmat + 9 * geom);
  }
}

// Sets `to`, [10], to the inertia of a body about a point at -`offset` from its centre of mass: the diagonal of the
// inertia matrix, its three off-diagonal elements, mass × offset, and the mass. `diagonal` has the principal moments of
// inertia, `m` the rotation of the inertial frame.
static inline void inertia(mjtNum* to, const mjtNum* diagonal, const mjtNum* m, const mjtNum* offset, mjtNum mass) {
  mjtNum scaled[9];  // [axis, row]
  for (int i = 0; i < 9; i++) scaled[i] = m[i % 3 * 3 + i / 3] * diagonal[i / 3];
  static const int rows[6] = {0, 1, 2, 0, 0, 1}, columns[6] = {0, 1, 2, 1, 2, 2};
  for (int i = 0; i < 6; i++) {
    const mjtNum* row = m + 3 * rows[i];
    const mjtNum* column = scaled + columns[i];
    to[i] = row[0] * column[0] + row[1] * column[3] + row[2] * column[6];
  }
  mjtNum x = offset[0], y = offset[1], z = offset[2];
  to[0] += mass * (y * y + z * z);
  to[1] += mass * (x * x + z * z);
  to[2] += mass * (x * x + y * y);
  to[3] -= mass * x * y;
  to[4] -= mass * x * z;
  to[5] -= mass * y * z;
  for (int i = 0; i < 3; i++) to[6 + i] = mass * offset[i];
  to[9] = mass;
}

void perturb_com_pos(const mjModel* m, mjData* d) {
  if (!is_walked(m) || m->nbody > MOST_BODIES) {
    mj_comPos(m, d);
    return;
  }
  mjtNum masses[MOST_BODIES] = {0};
  memset(d->subtree_com, 0, 3 * m->nbody * sizeof(mjtNum));
  for (int body = m->nbody - 1; body >= 0; body--) {
    mjtNum* com = d->subtree_com + 3 * body;
    for (int i = 0; i < 3; i++) com[i] += d->xipos[3 * body + i] * m->body_mass[body];
    masses[body] += m->body_mass[body];
    if (body) {
      int parent = m->body_parentid[body];
      for (int i = 0; i < 3; i++) d->subtree_com[3 * parent + i] += com[i];
      masses[parent] += masses[body];
    }
    if (masses[body] < mjMINVAL) {
      copy3(com, d->xipos + 3 * body);
    } else {
      mjtNum inverse = 1.0 / masses[body];
      for (int i = 0; i < 3; i++) com[i] *= inverse;
    }
  }
  for (int body = 1; body < m->nbody; body++) {
    mjtNum offset[3];
    subtract3(offset, d->xipos + 3 * body, d->subtree_com + 3 * m->body_rootid[body]);
    inertia(d->cinert + 10 * body, m->body_inertia + 3 * body, d->ximat + 9 * body, offset, m->body_mass[body]);
  }
  for (int joint = 0; joint < m->njnt; joint++) {
    mjtNum offset[3];
    mjtNum* to = d->cdof + 6 * m->jnt_dofadr[joint];
    const mjtNum* axis = d->xaxis + 3 * joint;
    if (m->jnt_type[joint] == mjJNT_SLIDE) {
      memset(to, 0, 3 * sizeof(mjtNum));
      copy3(to + 3, axis);
    } else {
      subtract3(offset, d->subtree_com + 3 * m->body_rootid[m->jnt_bodyid[joint]], d->xanchor + 3 * joint);
      copy3(to, axis);
      cross(to + 3, axis, offset);
    }
  }
}

void perturb_com_vel(const mjModel* m, mjData* d) {
  if (!is_walked(m)) {
    mj_comVel(m, d);
    return;
  }
  memset(d->cvel, 0, 6 * sizeof(mjtNum));
  for (int body = 1; body < m->nbody; body++) {
    mjtNum velocity[6];
    memcpy(velocity, d->cvel + 6 * m->body_parentid[body], sizeof velocity);
    for (int dof = m->body_dofadr[body]; dof < m->body_dofadr[body] + m->body_dofnum[body]; dof++) {
      const mjtNum* motion = d->cdof + 6 * dof;
      mjtNum* change = d->cdof_dot + 6 * dof;
      mjtNum turned[3];
      cross(change, velocity, motion);
      cross(change + 3, velocity, motion + 3);
      cross(turned, velocity + 3, motion);
      add3(change + 3, change + 3, turned);
      for (int i = 0; i < 6; i++) velocity[i] += motion[i] * d->qvel[dof];
    }
    memcpy(d->cvel + 6 * body, velocity, sizeof velocity);
  }
}

#else  // on other processors Debian's MuJoCo has fused multiply-add, whose bytes this code does not reproduce

void perturb_kinematics(const mjModel* m, mjData* d) { mj_kinematics(m, d); }
void perturb_com_pos(const mjModel* m, mjData* d) { mj_comPos(m, d); }
void perturb_com_vel(const mjModel* m, mjData* d) { mj_comVel(m, d); }

#endif
