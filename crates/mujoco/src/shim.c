// Calls MuJoCo so that a fatal error does not end the process. By default MuJoCo prints the error, waits for a key and
// ends the process. In this file each call that may fail runs under a thread-local error handler that jumps back to the
// call in this file. The jump crosses only C frames.
#include "shim.h"

#include <math.h>
#include <mujoco/mjxmacro.h>
#include <setjmp.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "kinematics.h"

// The library exports these functions, but no header declares them. MuJoCo's Python bindings use them in the same way.
typedef void (*Handler)(const char*);
Handler _mjPRIVATE__get_tls_error_fn(void);
void _mjPRIVATE__set_tls_error_fn(Handler handler);

static _Thread_local jmp_buf* landing;
static _Thread_local char last_error[512];

static void on_error(const char* message) {
  snprintf(last_error, sizeof last_error, "%s", message);
  longjmp(*landing, 1);
}

static void ignore_warning(const char* message) {
  (void)message;  // MuJoCo counts the warning in mjData.warning, which the Rust code reads
}

// Runs `statement` under the error handler. Afterwards `failed` is 1 if `statement` raised an error. Local variables
// that `statement` writes must be volatile, because other variables are undefined after the jump.
#define GUARDED(statement)                                \
  volatile int failed = 0;                                \
  jmp_buf here;                                           \
  Handler previous = _mjPRIVATE__get_tls_error_fn();      \
  landing = &here;                                        \
  _mjPRIVATE__set_tls_error_fn(on_error);                 \
  if (_setjmp(here) == 0) {                               \
    statement;                                            \
  } else {                                                \
    failed = 1;                                           \
  }                                                       \
  _mjPRIVATE__set_tls_error_fn(previous);                 \
  landing = NULL;

// Handles a fatal error outside of GUARDED, such as an error in the MJCF compiler. Unlike MuJoCo's own handler, this
// function neither writes a log file nor waits for a key.
static void end_process(const char* message) {
  fprintf(stderr, "MuJoCo: %s\n", message);
  fflush(stderr);
  _exit(EXIT_FAILURE);
}

void perturb_mj_silence(void) {
  mju_user_warning = ignore_warning;
  mju_user_error = end_process;
}

const char* perturb_mj_last_error(void) { return last_error; }

mjModel* perturb_mj_load(const char* xml, int xml_size, int n_files, const char* const* names, const void* const* data,
                         const int* sizes, char* error, int error_size) {
  // The struct has 2 MB, but only a few of its pages are used. It is filled by hand, because mj_addFileVFS would read
  // the files from the disk, and mj_deleteFileVFS would free `xml`.
  mjVFS* vfs = calloc(1, sizeof(mjVFS));
  if (!vfs) {
    snprintf(error, error_size, "out of memory");
    return NULL;
  }
  vfs->nfile = 1;
  strcpy(vfs->filename[0], "model.xml");
  vfs->filesize[0] = xml_size;
  vfs->filedata[0] = (void*)xml;
  for (int i = 0; i < n_files && vfs->nfile < mjMAXVFS; i++) {
    int at = vfs->nfile++;
    snprintf(vfs->filename[at], mjMAXVFSNAME, "%s", names[i]);
    vfs->filesize[at] = sizes[i];
    vfs->filedata[at] = (void*)data[i];
  }
  // This call is not in GUARDED, because the loader is C++, and no jump may cross frames of C++. The loader itself
  // catches errors of the engine.
  mjModel* model = mj_loadXML("model.xml", vfs, error, error_size);
  mj_freeLastXML();
  free(vfs);
  return model;
}

mjModel* perturb_mj_copy_model(const mjModel* source) {
  mjModel* volatile copy = NULL;
  GUARDED(copy = mj_copyModel(NULL, source))
  return failed ? NULL : copy;
}

int perturb_mj_same_sizes(const mjModel* a, const mjModel* b) {
  // All sizes are at the start of the struct, before the options.
  return memcmp(&a->nq, &b->nq, offsetof(mjModel, opt) - offsetof(mjModel, nq)) == 0;
}

int perturb_mj_set_model(mjModel* model, const mjModel* source) {
  GUARDED(mj_copyModel(model, source))
  return failed;
}

mjData* perturb_mj_make_data(const mjModel* model) {
  mjData* volatile data = NULL;
  GUARDED(data = mj_makeData(model))
  return failed ? NULL : data;
}

int perturb_mj_set_const(mjModel* model, mjData* data) {
  GUARDED(mj_setConst(model, data))
  return failed;
}

int perturb_mj_reset(const mjModel* model, mjData* data) {
  GUARDED(mj_resetData(model, data))
  return failed;
}

int perturb_mj_step1(const mjModel* model, mjData* data) {
  GUARDED(mj_step1(model, data))
  return failed;
}

int perturb_mj_step2(const mjModel* model, mjData* data) {
  GUARDED(mj_step2(model, data))
  return failed;
}

int perturb_mj_step(const mjModel* model, mjData* data) {
  GUARDED(mj_step(model, data))
  return failed;
}

struct perturb_mj_pairs {
  mjModel view;  // a shallow copy of the model that declares exactly these pairs; the argument of mj_collision
  int geoms[];   // each pair's geom of higher priority, whose contact parameters hold; then the index arrays of `view`
};

// Returns whether two geoms can touch, by MuJoCo's rules for geoms that the model does not declare as a pair.
static int can_touch(const mjModel* m, int a, int b) {
  return ((m->geom_contype[a] & m->geom_conaffinity[b]) || (m->geom_contype[b] & m->geom_conaffinity[a])) &&
         m->body_weldid[m->geom_bodyid[a]] != m->body_weldid[m->geom_bodyid[b]];
}

perturb_mj_pairs* perturb_mj_make_pairs(const mjModel* m) {
  if (m->npair || m->nexclude || m->opt.collision != mjCOL_ALL || m->opt.integrator != mjINT_EULER ||
      m->opt.enableflags) {
    return NULL;
  }
  int n = 0;
  for (int a = 0; a < m->ngeom; a++) {
    for (int b = a + 1; b < m->ngeom; b++) {
      if (!can_touch(m, a, b)) continue;
      // Geoms of two moving bodies need MuJoCo's search, and geoms of equal priority mix their contact parameters.
      if (m->geom_bodyid[a] != 0 || m->geom_priority[a] == m->geom_priority[b]) return NULL;
      n++;
    }
  }
  size_t numbers = (size_t)n * (mjNREF + mjNIMP + 5 + 2), indices = (size_t)n * 5;
  size_t head = (sizeof(perturb_mj_pairs) + indices * sizeof(int) + sizeof(mjtNum) - 1) / sizeof(mjtNum);
  perturb_mj_pairs* pairs = calloc(head + numbers, sizeof(mjtNum));
  if (!pairs) return NULL;
  mjModel* view = &pairs->view;
  *view = *m;
  view->npair = n;
  view->opt.collision = mjCOL_PAIR;
  view->pair_geom1 = pairs->geoms + n;
  view->pair_geom2 = pairs->geoms + 2 * n;
  view->pair_dim = pairs->geoms + 3 * n;
  view->pair_signature = pairs->geoms + 4 * n;
  view->pair_friction = (mjtNum*)pairs + head;
  view->pair_solref = view->pair_friction + 5 * n;
  view->pair_solimp = view->pair_solref + mjNREF * n;
  view->pair_margin = view->pair_solimp + mjNIMP * n;
  view->pair_gap = view->pair_margin + n;
  // The pairs are sorted by body, then by the world's geom, as MuJoCo sorts contacts.
  int i = 0;
  for (int body = 1; body < m->nbody; body++) {
    for (int a = m->body_geomadr[0]; a < m->body_geomadr[0] + m->body_geomnum[0]; a++) {
      for (int b = m->body_geomadr[body]; b < m->body_geomadr[body] + m->body_geomnum[body]; b++) {
        if (!can_touch(m, a, b)) continue;
        int geom = m->geom_priority[a] > m->geom_priority[b] ? a : b;
        pairs->geoms[i] = geom;
        view->pair_geom1[i] = a;
        view->pair_geom2[i] = b;
        view->pair_dim[i] = m->geom_condim[geom];
        view->pair_signature[i] = body + 1 + (1 << 16);
        memcpy(view->pair_solref + mjNREF * i, m->geom_solref + mjNREF * geom, mjNREF * sizeof(mjtNum));
        memcpy(view->pair_solimp + mjNIMP * i, m->geom_solimp + mjNIMP * geom, mjNIMP * sizeof(mjtNum));
        view->pair_margin[i] = mju_max(m->geom_margin[a], m->geom_margin[b]);
        view->pair_gap[i] = mju_max(m->geom_gap[a], m->geom_gap[b]);
        i++;
      }
    }
  }
  return pairs;
}

void perturb_mj_free_pairs(perturb_mj_pairs* pairs) { free(pairs); }

static void collide(const mjModel* model, perturb_mj_pairs* pairs, mjData* data) {
  // Copies the friction, which may have been edited since the pairs were made.
  for (int i = 0; i < pairs->view.npair; i++) {
    const mjtNum* from = model->geom_friction + 3 * pairs->geoms[i];
    mjtNum* to = pairs->view.pair_friction + 5 * i;
    to[0] = to[1] = from[0];
    to[2] = from[1];
    to[3] = to[4] = from[2];
  }
  mj_collision(&pairs->view, data);
}

// Does the same as mj_checkPos and mj_checkVel. It is faster, because MuJoCo's functions call another function for each
// number.
static void check(const mjModel* m, mjData* d) {
  int good = 1;
  for (int i = 0; i < m->nq; i++) good &= fabs(d->qpos[i]) <= mjMAXVAL;
  for (int i = 0; i < m->nv; i++) good &= fabs(d->qvel[i]) <= mjMAXVAL;
  if (good) return;
  mj_checkPos(m, d);
  mj_checkVel(m, d);
}

// Does the same as mj_fwdVelocity, but faster.
static void velocity(const mjModel* m, mjData* d) {
  if (m->ntendon) {
    mj_fwdVelocity(m, d);
    return;
  }
  mju_mulMatVec(d->actuator_velocity, d->actuator_moment, d->qvel, m->nu, m->nv);
  perturb_com_vel(m, d);
  mj_passive(m, d);
  mj_referenceConstraint(m, d);
  mj_rne(m, d, 0, d->qfrc_bias);
}

int perturb_mj_step_pairs(const mjModel* model, perturb_mj_pairs* pairs, mjData* data) {
  // These are the parts of mj_step1 and mj_step2. Some are replaced by faster functions.
  GUARDED(check(model, data); perturb_kinematics(model, data); perturb_com_pos(model, data); mj_camlight(model, data);
          mj_tendon(model, data); mj_crb(model, data); mj_factorM(model, data); collide(model, pairs, data);
          mj_makeConstraint(model, data); mj_transmission(model, data); mj_projectConstraint(model, data);
          mj_sensorPos(model, data); velocity(model, data); mj_sensorVel(model, data); mj_step2(model, data))
  return failed;
}

int perturb_mj_motion(const mjModel* model, mjData* data) {
  GUARDED(check(model, data); perturb_kinematics(model, data); perturb_com_pos(model, data);
          perturb_com_vel(model, data))
  return failed;
}

int perturb_mj_forward(const mjModel* model, mjData* data) {
  GUARDED(mj_forward(model, data))
  return failed;
}

int perturb_mj_rne_post_constraint(const mjModel* model, mjData* data) {
  GUARDED(mj_rnePostConstraint(model, data))
  return failed;
}

int perturb_mj_kinematics(const mjModel* model, mjData* data) {
  GUARDED(mj_kinematics(model, data); mj_comPos(model, data); mj_camlight(model, data); mj_tendon(model, data))
  return failed;
}

int perturb_mjv_make_scene(const mjModel* model, mjvScene* scene, int most_geoms) {
  GUARDED(mjv_makeScene(model, scene, most_geoms))
  return failed;
}

int perturb_mjv_update_scene(const mjModel* model, mjData* data, const mjvOption* option, mjvCamera* camera,
                             mjvScene* scene) {
  // The camera is moved first. mjv_updateScene alone would put the headlight at the camera's previous position, so a
  // picture would depend on the picture before.
  GUARDED(mjv_updateCamera(model, data, camera, scene);
          mjv_updateScene(model, data, option, NULL, camera, mjCAT_ALL, scene))
  return failed;
}

int perturb_mjr_make_context(mjModel* model, mjrContext* context, int width, int height) {
  model->vis.global.offwidth = width;
  model->vis.global.offheight = height;
  // mjr_makeContext calls MuJoCo's OpenGL loader, which is C++. The loader raises an error only if no OpenGL library is
  // loaded. This cannot happen, because an OpenGL context is current.
  GUARDED(mjr_makeContext(model, context, mjFONTSCALE_50); mjr_setBuffer(mjFB_OFFSCREEN, context))
  if (!failed && context->currentBuffer != mjFB_OFFSCREEN) {
    snprintf(last_error, sizeof last_error, "OpenGL has no off-screen framebuffer");
    return 1;
  }
  return failed;
}

int perturb_mjr_free_context(mjrContext* context) {
  GUARDED(mjr_freeContext(context))
  return failed;
}

int perturb_mjr_draw(mjvScene* scene, const mjrContext* context, int width, int height, unsigned char* pixels) {
  mjrRect viewport = {0, 0, width, height};
  GUARDED(mjr_render(viewport, scene, context); mjr_readPixels(pixels, NULL, viewport, context))
  int error = failed ? 0 : mjr_getError();
  if (error) {
    snprintf(last_error, sizeof last_error, "OpenGL error 0x%x", error);
    return 1;
  }
  return failed;
}

#define FLOAT_SIZE(pointer) _Generic((pointer), mjtNum*: sizeof(mjtNum), float*: sizeof(float), default: 0)

int perturb_mj_array(const mjModel* m, int index, const char** name, const void** elements, int* count,
                     int* float_size) {
  MJMODEL_POINTERS_PREAMBLE(m)
  int at = 0;
#define X(type, field, rows, columns)          \
  if (at++ == index) {                         \
    *name = #field;                            \
    *elements = m->field;                      \
    *count = m->rows * (columns);              \
    *float_size = (int)FLOAT_SIZE(m->field);   \
    return 1;                                  \
  }
  MJMODEL_POINTERS
#undef X
  if (at == index) {  // after the arrays come the statistics: four numbers and a vector of three
    *name = "stat";
    *elements = &m->stat;
    *count = (int)(sizeof(mjStatistic) / sizeof(mjtNum));
    *float_size = (int)sizeof(mjtNum);
    return 1;
  }
  return 0;
}
