// The functions that the Rust code calls. A fatal error of MuJoCo does not end the process: the function returns a
// failure.
#ifndef PERTURB_MUJOCO_SHIM_H_
#define PERTURB_MUJOCO_SHIM_H_

#include <mujoco/mujoco.h>

// Stops MuJoCo from writing a log file. A fatal error in a call without an error handler (see GUARDED in shim.c) then
// ends the process with a line on standard error. May be called again, but not while another thread uses MuJoCo.
void perturb_mj_silence(void);

// Returns the message of this thread's last failure. It is valid until the thread's next failure.
const char* perturb_mj_last_error(void);

// Compiles MJCF text to a model. The text may use `n_files` files, fewer than mjMAXVFS. `names`, `data` and `sizes`
// have the name, content and size in bytes of each file; names must be shorter than mjMAXVFSNAME. Returns NULL on
// failure, with the reason in `error`. Only one call at a time is allowed in the process.
mjModel* perturb_mj_load(const char* xml, int xml_size, int n_files, const char* const* names, const void* const* data,
                         const int* sizes, char* error, int error_size);

// Return a copy of a model, and new data for a model. Both return NULL on failure.
mjModel* perturb_mj_copy_model(const mjModel* source);
mjData* perturb_mj_make_data(const mjModel* model);

// Returns 1 if all sizes of two models are equal, otherwise 0.
int perturb_mj_same_sizes(const mjModel* a, const mjModel* b);
// Copies `source` into `model`, which must have the same sizes. The arrays of `model` do not move. Returns nonzero on
// failure.
int perturb_mj_set_model(mjModel* model, const mjModel* source);

// Each function calls MuJoCo's function for the same purpose, such as mj_setConst, and returns nonzero on failure.
int perturb_mj_set_const(mjModel* model, mjData* data);
int perturb_mj_reset(const mjModel* model, mjData* data);
int perturb_mj_step1(const mjModel* model, mjData* data);
int perturb_mj_step2(const mjModel* model, mjData* data);
int perturb_mj_step(const mjModel* model, mjData* data);
int perturb_mj_forward(const mjModel* model, mjData* data);
int perturb_mj_rne_post_constraint(const mjModel* model, mjData* data);

// The pairs of geoms of a model that can touch. In each pair one geom belongs to the world.
typedef struct perturb_mj_pairs perturb_mj_pairs;
// Finds the pairs of geoms that can touch. Returns NULL if geoms of two moving bodies can touch, if the parameters of a
// contact come from both of its geoms, if the model has another integrator than Euler's or unusual collision options,
// or if there is not enough memory. The caller owns the result. The model must outlive it.
perturb_mj_pairs* perturb_mj_make_pairs(const mjModel* model);
void perturb_mj_free_pairs(perturb_mj_pairs* pairs);
// Gives the same bytes as perturb_mj_step, but does not search for geoms that are near each other. Returns nonzero on
// failure.
int perturb_mj_step_pairs(const mjModel* model, perturb_mj_pairs* pairs, mjData* data);

// Computes only the poses of bodies, geoms, cameras, lights and tendons. Returns nonzero on failure.
int perturb_mj_kinematics(const mjModel* model, mjData* data);

// Checks positions and velocities, and computes only the poses and velocities of bodies. Returns nonzero on failure.
int perturb_mj_motion(const mjModel* model, mjData* data);

// Functions for drawing, which return nonzero on failure. Those that begin with perturb_mjr need a current OpenGL
// context, and only one of them may run at a time.
int perturb_mjv_make_scene(const mjModel* model, mjvScene* scene, int most_geoms);
int perturb_mjv_update_scene(const mjModel* model, mjData* data, const mjvOption* option, mjvCamera* camera,
                             mjvScene* scene);
// Makes a drawing context with a buffer of this size in pixels. `context` must be a default or freed one.
int perturb_mjr_make_context(mjModel* model, mjrContext* context, int width, int height);
int perturb_mjr_free_context(mjrContext* context);
// Draws the scene, and copies the picture to `pixels`: 3 * width * height bytes, bottom row first.
int perturb_mjr_draw(mjvScene* scene, const mjrContext* context, int width, int height, unsigned char* pixels);

// Describes the model's array with this index: its name, elements, their count, and the size of an element in bytes if
// it is a floating-point number, otherwise 0. Returns 0 if `index` is beyond the last array, otherwise 1.
int perturb_mj_array(const mjModel* model, int index, const char** name, const void** elements, int* count,
                     int* float_size);

#endif  // PERTURB_MUJOCO_SHIM_H_
