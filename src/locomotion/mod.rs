//! Hopper and HalfCheetah: Roboschool's task on MuJoCo.
