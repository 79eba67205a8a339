// What the Rust side calls. Every function that may raise a fatal error in MuJoCo returns it as a value.
#ifndef PERTURB_MUJOCO_SHIM_H_
#define PERTURB_MUJOCO_SHIM_H_

#include <mujoco/mujoco.h>

// Silences MuJoCo's log file: an error outside of a guarded call ends the process with a line on standard error.
// Idempotent, but not to be raced.
void perturb_mj_silence(void);

// The message of the last failure on this thread; valid until the next one.
const char* perturb_mj_last_error(void);

// Compiles MJCF text, which may name `n_files` files of these names, bytes and sizes, fewer than mjMAXVFS and with names
// shorter than mjMAXVFSNAME. NULL on failure, with the reason in `error`. One call at a time in the whole process.
mjModel* perturb_mj_load(const char* xml, int xml_size, int n_files, const char* const* names, const void* const* data,
                         const int* sizes, char* error, int error_size);

// NULL on failure.
mjModel* perturb_mj_copy_model(const mjModel* source);
mjData* perturb_mj_make_data(const mjModel* model);

// Whether all sizes of two models are the same.
int perturb_mj_same_sizes(const mjModel* a, const mjModel* b);
// Copies a model of the same sizes into another one, whose arrays stay where they are. Nonzero on failure.
int perturb_mj_set_model(mjModel* model, const mjModel* source);

// Nonzero on failure.
int perturb_mj_set_const(mjModel* model, mjData* data);
int perturb_mj_reset(const mjModel* model, mjData* data);
int perturb_mj_step1(const mjModel* model, mjData* data);
int perturb_mj_step2(const mjModel* model, mjData* data);
int perturb_mj_step(const mjModel* model, mjData* data);
int perturb_mj_forward(const mjModel* model, mjData* data);
int perturb_mj_rne_post_constraint(const mjModel* model, mjData* data);

// The pairs of geoms of a model that can touch, where the world has one of each.
typedef struct perturb_mj_pairs perturb_mj_pairs;
// NULL if other pairs can touch, too, if their contacts take after both geoms, if the model steps otherwise than by
// Euler's method, or without memory. The model must outlive the result, which belongs to the caller.
perturb_mj_pairs* perturb_mj_make_pairs(const mjModel* model);
void perturb_mj_free_pairs(perturb_mj_pairs* pairs);
// perturb_mj_step, to the same bytes, without the search for geoms that are near each other. Nonzero on failure.
int perturb_mj_step_pairs(const mjModel* model, perturb_mj_pairs* pairs, mjData* data);

// Poses of bodies, geoms, cameras and lights, and nothing else. Nonzero on failure.
int perturb_mj_kinematics(const mjModel* model, mjData* data);

// Checks positions and velocities; poses and velocities of bodies, and nothing else. Nonzero on failure.
int perturb_mj_motion(const mjModel* model, mjData* data);

// Drawing. Nonzero on failure. Those of mjr need a current OpenGL context, and are not to be raced.
int perturb_mjv_make_scene(const mjModel* model, mjvScene* scene, int most_geoms);
int perturb_mjv_update_scene(const mjModel* model, mjData* data, const mjvOption* option, mjvCamera* camera,
                             mjvScene* scene);
// Makes the context draw into a buffer of this size in pixels; the context is a default or a freed one.
int perturb_mjr_make_context(mjModel* model, mjrContext* context, int width, int height);
int perturb_mjr_free_context(mjrContext* context);
// Draws the scene and reads the picture: 3 * width * height bytes, the lowest row first.
int perturb_mjr_draw(mjvScene* scene, const mjrContext* context, int width, int height, unsigned char* pixels);

// The model's array number `index`: its name, elements, their number, and the bytes of a floating-point element, or 0
// for other types. Zero is returned beyond the last array.
int perturb_mj_array(const mjModel* model, int index, const char** name, const void** elements, int* count,
                     int* float_size);

#endif  // PERTURB_MUJOCO_SHIM_H_
