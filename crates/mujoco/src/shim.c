// MuJoCo answers a fatal error by printing, waiting for a key and ending the process. Here each call that may fail runs
// under a handler of its own thread, which jumps back into the shim: only frames of MuJoCo's C engine lie between.
#include "shim.h"

#include <mujoco/mjxmacro.h>
#include <setjmp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

// Exported, but in no header; MuJoCo's Python bindings use them in the same way.
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
  (void)message;  // counted in mjData.warning, where the Rust side reads it
}

// Runs `statement`; `failed` becomes 1 if it raised an error. No local that `statement` writes survives the jump unless
// it is volatile.
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

void perturb_mj_silence(void) { mju_user_warning = ignore_warning; }

const char* perturb_mj_last_error(void) { return last_error; }

mjModel* perturb_mj_load(const char* xml, int xml_size, char* error, int error_size) {
  // 2 MB, of which a few pages are touched. mj_addFileVFS would read a file and mj_deleteFileVFS free `xml`.
  mjVFS* vfs = calloc(1, sizeof(mjVFS));
  if (!vfs) {
    snprintf(error, error_size, "out of memory");
    return NULL;
  }
  vfs->nfile = 1;
  strcpy(vfs->filename[0], "model.xml");
  vfs->filesize[0] = xml_size;
  vfs->filedata[0] = (void*)xml;
  // No handler here: the loader is C++, which no jump may cross, and catches its engine's errors itself.
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

int perturb_mj_motion(const mjModel* model, mjData* data) {
  GUARDED(mj_checkPos(model, data); mj_checkVel(model, data); mj_kinematics(model, data); mj_comPos(model, data);
          mj_comVel(model, data))
  return failed;
}

int perturb_mj_forward(const mjModel* model, mjData* data) {
  GUARDED(mj_forward(model, data))
  return failed;
}

int perturb_mj_kinematics(const mjModel* model, mjData* data) {
  GUARDED(mj_kinematics(model, data); mj_comPos(model, data); mj_camlight(model, data))
  return failed;
}

int perturb_mjv_make_scene(const mjModel* model, mjvScene* scene, int most_geoms) {
  GUARDED(mjv_makeScene(model, scene, most_geoms))
  return failed;
}

int perturb_mjv_update_scene(const mjModel* model, mjData* data, const mjvOption* option, mjvCamera* camera,
                             mjvScene* scene) {
  // The headlight is put where the scene's camera is before mjv_updateScene moves it: a picture would depend on the last.
  GUARDED(mjv_updateCamera(model, data, camera, scene);
          mjv_updateScene(model, data, option, NULL, camera, mjCAT_ALL, scene))
  return failed;
}

int perturb_mjr_make_context(mjModel* model, mjrContext* context, int width, int height) {
  model->vis.global.offwidth = width;
  model->vis.global.offheight = height;
  // MuJoCo's loader of OpenGL, which this calls, is C++. It raises an error only where no library of OpenGL is loaded;
  // the current context is of one.
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
  if (at == index) {  // the statistics follow from the arrays: five of them, the last of three numbers
    *name = "stat";
    *elements = &m->stat;
    *count = (int)(sizeof(mjStatistic) / sizeof(mjtNum));
    *float_size = (int)sizeof(mjtNum);
    return 1;
  }
  return 0;
}
