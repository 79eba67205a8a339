//! The arrays of a model and of a simulation, by name.

use crate::sys;

/// Declares an enum of arrays of the model, each with its MuJoCo name and its number of elements.
macro_rules! model_arrays {
    ($(#[$about:meta])* $name:ident: $type:ty, { $($(#[$doc:meta])* $field:ident = $raw:ident: $length:expr,)* }) => {
        $(#[$about])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        pub enum $name {
            $($(#[$doc])* $field,)*
        }

        impl $name {
            /// The first element of the array in this model, and the number of elements.
            pub(crate) fn place(self, m: &sys::mjModel) -> (*mut $type, usize) {
                match self {
                    $(Self::$field => {
                        let length: fn(&sys::mjModel) -> i32 = $length;
                        (m.$raw, length(m).max(0) as usize)
                    })*
                }
            }
        }
    };
}

macro_rules! float_fields {
    ($($(#[$doc:meta])* $field:ident = $raw:ident: $length:expr,)*) => {
        /// A floating-point array of a model, or numbers of its options.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        pub enum Field {
            $($(#[$doc])* $field,)*
            /// Gravity in m/s², `[3]`.
            Gravity,
            /// Wind in m/s, `[3]`.
            Wind,
            /// Density of the medium in kg/m³, `[1]`.
            Density,
            /// Viscosity of the medium in Pa s, `[1]`.
            Viscosity,
            /// Mean inertia, mean mass, mean size, extent, and the centre's x, y and z, `[7]`.
            Statistic,
        }

        impl Field {
            /// The first element of the array in this model, and the number of elements.
            ///
            /// # Safety
            /// `raw` is a valid model, which nobody writes during the call.
            pub(crate) unsafe fn place(self, raw: *mut sys::mjModel) -> (*mut f64, usize) {
                // SAFETY: the caller passes a valid model.
                let m = unsafe { &*raw };
                match self {
                    $(Self::$field => {
                        let length: fn(&sys::mjModel) -> i32 = $length;
                        (m.$raw, length(m).max(0) as usize)
                    })*
                    // SAFETY: the caller passes a valid model; only addresses are taken.
                    Self::Gravity => (unsafe { &raw mut (*raw).opt.gravity }.cast(), 3),
                    // SAFETY: as above.
                    Self::Wind => (unsafe { &raw mut (*raw).opt.wind }.cast(), 3),
                    // SAFETY: as above.
                    Self::Density => (unsafe { &raw mut (*raw).opt.density }, 1),
                    // SAFETY: as above.
                    Self::Viscosity => (unsafe { &raw mut (*raw).opt.viscosity }, 1),
                    Self::Statistic => {
                        // SAFETY: as above. The statistics are plain numbers of one type.
                        let start = unsafe { &raw mut (*raw).stat }.cast();
                        (start, size_of::<sys::mjStatistic>() / size_of::<f64>())
                    }
                }
            }
        }
    };
}

float_fields! {
    /// Masses in kg, `[B]`.
    BodyMass = body_mass: |m| m.nbody,
    /// Principal moments of inertia in kg m², `[B, 3]`.
    BodyInertia = body_inertia: |m| 3 * m.nbody,
    /// Masses of subtrees in kg, `[B]`.
    BodySubtreeMass = body_subtreemass: |m| m.nbody,
    /// Mean inverse inertia of bodies in the initial pose, `[B, 2]`.
    BodyInvWeight = body_invweight0: |m| 2 * m.nbody,
    /// Positions of bodies' frames in those of their parents in m, `[B, 3]`.
    BodyPosition = body_pos: |m| 3 * m.nbody,
    /// Rotations of bodies' frames in those of their parents, as quaternions, `[B, 4]`.
    BodyRotation = body_quat: |m| 4 * m.nbody,
    /// Sizes of geoms in m, `[G, 3]`: of a sphere the radius, of a capsule or cylinder the radius and half of the length.
    GeomSize = geom_size: |m| 3 * m.ngeom,
    /// Sliding, torsional and rolling friction of geoms, `[G, 3]`.
    GeomFriction = geom_friction: |m| 3 * m.ngeom,
    /// Friction of declared pairs: two sliding, one torsional, two rolling, `[P, 5]`.
    PairFriction = pair_friction: |m| 5 * m.npair,
    /// Damping of degrees of freedom, `[V]`.
    DofDamping = dof_damping: |m| m.nv,
    /// Armature of degrees of freedom, `[V]`.
    DofArmature = dof_armature: |m| m.nv,
    /// Friction loss of degrees of freedom, `[V]`.
    DofFrictionLoss = dof_frictionloss: |m| m.nv,
    /// Inverse inertia of degrees of freedom in the initial pose, `[V]`.
    DofInvWeight = dof_invweight0: |m| m.nv,
    /// Inertia of degrees of freedom in the initial pose, `[V]`.
    DofInertia = dof_M0: |m| m.nv,
    /// Stiffness of joints, `[J]`.
    JointStiffness = jnt_stiffness: |m| m.njnt,
    /// Limits of joints in rad or m, `[J, 2]`.
    JointRange = jnt_range: |m| 2 * m.njnt,
    /// Anchors of joints in the frames of their bodies in m, `[J, 3]`.
    JointAnchor = jnt_pos: |m| 3 * m.njnt,
    /// Initial positions, `[Q]`.
    InitialPositions = qpos0: |m| m.nq,
    /// Gears of actuators, `[U, 6]`.
    ActuatorGear = actuator_gear: |m| 6 * m.nu,
    /// Gain parameters of actuators, `[U, 10]`.
    ActuatorGain = actuator_gainprm: |m| sys::mjNGAIN as i32 * m.nu,
    /// Bias parameters of actuators, `[U, 10]`.
    ActuatorBias = actuator_biasprm: |m| sys::mjNBIAS as i32 * m.nu,
    /// Limits of controls, `[U, 2]`.
    ActuatorControlRange = actuator_ctrlrange: |m| 2 * m.nu,
    /// Limits of forces, `[U, 2]`.
    ActuatorForceRange = actuator_forcerange: |m| 2 * m.nu,
    /// Acceleration from a unit force in the initial pose, `[U]`.
    ActuatorAcceleration = actuator_acc0: |m| m.nu,
    /// Lengths of actuators in the initial pose, `[U]`.
    ActuatorLength = actuator_length0: |m| m.nu,
    /// Stiffness of tendons, `[T]`.
    TendonStiffness = tendon_stiffness: |m| m.ntendon,
    /// Damping of tendons, `[T]`.
    TendonDamping = tendon_damping: |m| m.ntendon,
    /// Lengths of tendons in the initial pose, `[T]`.
    TendonLength = tendon_length0: |m| m.ntendon,
    /// Inverse weights of tendons in the initial pose, `[T]`.
    TendonInvWeight = tendon_invweight0: |m| m.ntendon,
    /// Positions of keyframes, `[K, Q]`.
    KeyPositions = key_qpos: |m| m.nkey * m.nq,
    /// Velocities of keyframes, `[K, V]`.
    KeyVelocities = key_qvel: |m| m.nkey * m.nv,
}

/// The fields that edits of masses, inertias and friction change, or that mj_setConst computes from them.
pub(crate) const CONSTANTS: [Field; 9] = [
    Field::BodyMass,
    Field::BodyInertia,
    Field::GeomFriction,
    Field::BodySubtreeMass,
    Field::BodyInvWeight,
    Field::DofInvWeight,
    Field::DofInertia,
    Field::ActuatorAcceleration,
    Field::Statistic,
];

impl Field {
    /// The fields that [`Simulation::set_const`](crate::Simulation::set_const) computes and that physics depends on.
    pub const DERIVED: [Self; 9] = [
        Self::BodySubtreeMass,
        Self::BodyInvWeight,
        Self::DofInvWeight,
        Self::DofInertia,
        Self::TendonLength,
        Self::TendonInvWeight,
        Self::ActuatorAcceleration,
        Self::ActuatorLength,
        Self::Statistic,
    ];
}

model_arrays! {
    /// An array of whole numbers of a model.
    Index: i32, {
        /// Parents of bodies, `[B]`.
        BodyParent = body_parentid: |m| m.nbody,
        /// The body that each body is welded to, `[B]`; 0 is the world.
        BodyWeld = body_weldid: |m| m.nbody,
        /// Types of joints: 0 free, 1 ball, 2 slide, 3 hinge, `[J]`.
        JointType = jnt_type: |m| m.njnt,
        /// First entries of joints in `qpos`, `[J]`.
        JointPosition = jnt_qposadr: |m| m.njnt,
        /// First entries of joints in `qvel`, `[J]`.
        JointVelocity = jnt_dofadr: |m| m.njnt,
        /// Bodies of joints, `[J]`.
        JointBody = jnt_bodyid: |m| m.njnt,
        /// Types of geoms, of `mjtGeom`: 2 sphere, 3 capsule, 5 cylinder, 7 mesh, `[G]`.
        GeomType = geom_type: |m| m.ngeom,
        /// Bodies of geoms, `[G]`.
        GeomBody = geom_bodyid: |m| m.ngeom,
        /// Contact types of geoms, `[G]`.
        GeomContactType = geom_contype: |m| m.ngeom,
        /// Contact affinities of geoms, `[G]`.
        GeomContactAffinity = geom_conaffinity: |m| m.ngeom,
        /// Priorities of geoms, `[G]`.
        GeomPriority = geom_priority: |m| m.ngeom,
        /// Contact dimensions of geoms, `[G]`.
        GeomContactDimension = geom_condim: |m| m.ngeom,
        /// First geoms of declared pairs, `[P]`.
        PairGeom1 = pair_geom1: |m| m.npair,
        /// Second geoms of declared pairs, `[P]`.
        PairGeom2 = pair_geom2: |m| m.npair,
        /// Contact dimensions of declared pairs, `[P]`.
        PairContactDimension = pair_dim: |m| m.npair,
        /// Types of dynamics of actuators, `[U]`; 0 is none.
        ActuatorDynamics = actuator_dyntype: |m| m.nu,
        /// Types of gains of actuators, `[U]`; 0 is fixed.
        ActuatorGainType = actuator_gaintype: |m| m.nu,
        /// Types of biases of actuators, `[U]`; 0 none, 1 affine.
        ActuatorBiasType = actuator_biastype: |m| m.nu,
        /// Types of transmissions of actuators, `[U]`; 0 joint, 1 joint in the parent's frame.
        ActuatorTransmission = actuator_trntype: |m| m.nu,
        /// Targets of actuators, `[U, 2]`.
        ActuatorTarget = actuator_trnid: |m| 2 * m.nu,
        /// First numbers of sensors, `[S]`.
        SensorAddress = sensor_adr: |m| m.nsensor,
        /// Numbers of each sensor, `[S]`.
        SensorDimension = sensor_dim: |m| m.nsensor,
    }
}

model_arrays! {
    /// An array of flags of a model, 0 or 1.
    Flags: u8, {
        /// Whether joints have limits, `[J]`.
        JointLimited = jnt_limited: |m| m.njnt,
        /// Whether controls have limits, `[U]`.
        ActuatorControlLimited = actuator_ctrllimited: |m| m.nu,
        /// Whether forces have limits, `[U]`.
        ActuatorForceLimited = actuator_forcelimited: |m| m.nu,
    }
}

/// Options of a model that are whole numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Options {
    /// 0 Euler, 1 RK4, 2 implicit.
    pub integrator: i32,
    /// 0 all, 1 declared pairs only, 2 dynamic only.
    pub collision: i32,
    /// Bits of `mjtDisableBit`.
    pub disable_flags: i32,
    /// Bits of `mjtEnableBit`.
    pub enable_flags: i32,
}

impl Options {
    /// No constraints at all.
    pub const DISABLE_CONSTRAINT: i32 = 1;
    /// No friction loss.
    pub const DISABLE_FRICTION_LOSS: i32 = 1 << 2;
    /// No limits of joints and tendons.
    pub const DISABLE_LIMIT: i32 = 1 << 3;
    /// No contacts.
    pub const DISABLE_CONTACT: i32 = 1 << 4;
    /// No springs, dampers and fluid forces.
    pub const DISABLE_PASSIVE: i32 = 1 << 5;
    /// No gravity.
    pub const DISABLE_GRAVITY: i32 = 1 << 6;
    /// No actuation.
    pub const DISABLE_ACTUATION: i32 = 1 << 10;
}

macro_rules! data_arrays {
    ($($(#[$doc:meta])* $field:ident = $raw:ident: $length:expr,)*) => {
        /// An array that MuJoCo computes.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        pub enum Reading {
            $($(#[$doc])* $field,)*
        }

        impl Reading {
            /// The first element of the array in these data of a model, and the number of elements.
            pub(crate) fn place(self, d: &sys::mjData, m: &sys::mjModel) -> (*mut f64, usize) {
                match self {
                    $(Self::$field => {
                        let length: fn(&sys::mjModel) -> i32 = $length;
                        (d.$raw, length(m).max(0) as usize)
                    })*
                }
            }
        }
    };
}

data_arrays! {
    /// Positions, `[Q]`.
    Positions = qpos: |m| m.nq,
    /// Velocities, `[V]`.
    Velocities = qvel: |m| m.nv,
    /// Controls, `[U]`.
    Controls = ctrl: |m| m.nu,
    /// Activations, `[n_act]`.
    Activations = act: |m| m.na,
    /// Origins of bodies' frames in m, `[B, 3]`.
    BodyPositions = xpos: |m| 3 * m.nbody,
    /// Rotation matrices of bodies' frames, row-major, `[B, 9]`.
    BodyRotations = xmat: |m| 9 * m.nbody,
    /// Centres of mass of bodies in m, `[B, 3]`.
    BodyCentres = xipos: |m| 3 * m.nbody,
    /// Positions of geoms in m, `[G, 3]`.
    GeomPositions = geom_xpos: |m| 3 * m.ngeom,
    /// Positions of sites in m, `[site, 3]`.
    SitePositions = site_xpos: |m| 3 * m.nsite,
    /// Inertias and masses of bodies about the centre of mass of their tree, `[B, 10]`.
    BodyInertias = cinert: |m| 10 * m.nbody,
    /// Velocities of bodies about the centre of mass of their tree, rotation first, `[B, 6]`.
    BodyVelocities = cvel: |m| 6 * m.nbody,
    /// External forces on bodies about the centre of mass of their tree, torque first, `[B, 6]`.
    BodyExternalForces = cfrc_ext: |m| 6 * m.nbody,
    /// Forces of actuators on degrees of freedom, `[V]`.
    DofActuation = qfrc_actuator: |m| m.nv,
    /// Forces of constraints on degrees of freedom, `[V]`.
    DofConstraint = qfrc_constraint: |m| m.nv,
    /// Forces of actuators, `[U]`.
    ActuatorForces = actuator_force: |m| m.nu,
    /// Numbers of sensors.
    Sensors = sensordata: |m| m.nsensordata,
}
