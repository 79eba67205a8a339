//! Names of the arrays of models and simulations, by which their values are read and edited.

use crate::sys;

/// Declares an enum of arrays of the model. Each variant states the array's name in MuJoCo and the number of its
/// elements.
macro_rules! model_arrays {
    ($(#[$about:meta])* $name:ident: $type:ty, { $($(#[$doc:meta])* $field:ident = $raw:ident: $length:expr,)* }) => {
        $(#[$about])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        pub enum $name {
            $($(#[$doc])* $field,)*
        }

        impl $name {
            /// A pointer to the first element of the array in this model, and the number of elements.
            pub(crate) fn pointer_and_length(self, m: &sys::mjModel) -> (*mut $type, usize) {
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
        /// A floating-point array of a model, or one of its numeric options.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        pub enum ModelField {
            $($(#[$doc])* $field,)*
            /// Gravity in m/s², `[3]`.
            Gravity,
            /// Velocity of the wind in m/s, `[3]`.
            Wind,
            /// Density of the medium around the bodies in kg/m³, `[1]`.
            Density,
            /// Viscosity of the medium around the bodies in Pa s, `[1]`.
            Viscosity,
            /// Statistics of the model, `[7]`: mean inertia, mean mass, mean body size, spatial extent, and the
            /// centre's x, y and z.
            Statistic,
        }

        impl ModelField {
            /// A pointer to the first element of the array in this model, and the number of elements.
            ///
            /// # Safety
            /// `raw` must point to a valid model that is not written during the call.
            pub(crate) unsafe fn pointer_and_length(self, raw: *mut sys::mjModel) -> (*mut f64, usize) {
                // SAFETY: the caller passes a valid model.
                let m = unsafe { &*raw };
                match self {
                    $(Self::$field => {
                        let length: fn(&sys::mjModel) -> i32 = $length;
                        (m.$raw, length(m).max(0) as usize)
                    })*
                    // SAFETY: the caller passes a valid model. This takes only the address of the field.
                    Self::Gravity => (unsafe { &raw mut (*raw).opt.gravity }.cast(), 3),
                    // SAFETY: the caller passes a valid model. This takes only the address of the field.
                    Self::Wind => (unsafe { &raw mut (*raw).opt.wind }.cast(), 3),
                    // SAFETY: the caller passes a valid model. This takes only the address of the field.
                    Self::Density => (unsafe { &raw mut (*raw).opt.density }, 1),
                    // SAFETY: the caller passes a valid model. This takes only the address of the field.
                    Self::Viscosity => (unsafe { &raw mut (*raw).opt.viscosity }, 1),
                    Self::Statistic => {
                        // SAFETY: the caller passes a valid model. The statistics are seven successive f64.
                        let start = unsafe { &raw mut (*raw).stat }.cast();
                        (start, size_of::<sys::mjStatistic>() / size_of::<f64>())
                    }
                }
            }
        }
    };
}

float_fields! {
    /// Masses of bodies in kg, `[bodies]`.
    BodyMass = body_mass: |m| m.nbody,
    /// Principal moments of inertia of bodies in kg m², `[bodies, 3]`.
    BodyInertia = body_inertia: |m| 3 * m.nbody,
    /// Total mass of each body and all its descendants in kg, `[bodies]`.
    BodySubtreeMass = body_subtreemass: |m| m.nbody,
    /// Mean inverse inertia of each body in the initial pose, `[bodies, 2]`: for translation and rotation.
    BodyInvWeight = body_invweight0: |m| 2 * m.nbody,
    /// Position of each body's frame relative to its parent's frame in m, `[bodies, 3]`.
    BodyPosition = body_pos: |m| 3 * m.nbody,
    /// Rotation of each body's frame relative to its parent's frame, as a quaternion, `[bodies, 4]`.
    BodyRotation = body_quat: |m| 4 * m.nbody,
    /// Sizes of geoms in m, `[geoms, 3]`. A sphere has its radius in the first entry; a capsule or cylinder has its
    /// radius in the first and half of its length in the second.
    GeomSize = geom_size: |m| 3 * m.ngeom,
    /// Sliding, torsional and rolling friction coefficients of geoms, `[geoms, 3]`.
    GeomFriction = geom_friction: |m| 3 * m.ngeom,
    /// Friction coefficients of the pairs of geoms that the model declares, `[pairs, 5]`: two sliding, one torsional,
    /// two rolling.
    PairFriction = pair_friction: |m| 5 * m.npair,
    /// Damping of degrees of freedom, `[dofs]`: N s/m for translation, N m s/rad for rotation.
    DofDamping = dof_damping: |m| m.nv,
    /// Armature of degrees of freedom, `[dofs]`: an inertia that is added to each degree of freedom, e.g. the inertia
    /// of a motor's rotor. In kg for translation, kg m² for rotation.
    DofArmature = dof_armature: |m| m.nv,
    /// Dry friction of degrees of freedom, `[dofs]`: N for translation, N m for rotation.
    DofFrictionLoss = dof_frictionloss: |m| m.nv,
    /// Inverse inertia of degrees of freedom in the initial pose, `[dofs]`: 1/kg for translation, 1/(kg m²) for
    /// rotation.
    DofInvWeight = dof_invweight0: |m| m.nv,
    /// Inertia of degrees of freedom in the initial pose, `[dofs]`: kg for translation, kg m² for rotation.
    DofInertia = dof_M0: |m| m.nv,
    /// Spring stiffness of joints, `[joints]`: N/m for slides, N m/rad for hinges.
    JointStiffness = jnt_stiffness: |m| m.njnt,
    /// Lower and upper limits of joints in rad or m, `[joints, 2]`.
    JointRange = jnt_range: |m| 2 * m.njnt,
    /// Position of each joint's anchor in its body's frame in m, `[joints, 3]`.
    JointAnchor = jnt_pos: |m| 3 * m.njnt,
    /// Initial generalised positions, `[n_q]`.
    InitialPositions = qpos0: |m| m.nq,
    /// Gear ratios of actuators, `[actuators, 6]`.
    ActuatorGear = actuator_gear: |m| 6 * m.nu,
    /// Gain parameters of actuators, `[actuators, 10]`.
    ActuatorGain = actuator_gainprm: |m| sys::mjNGAIN as i32 * m.nu,
    /// Bias parameters of actuators, `[actuators, 10]`.
    ActuatorBias = actuator_biasprm: |m| sys::mjNBIAS as i32 * m.nu,
    /// Lower and upper limits of the actuators' controls, `[actuators, 2]`.
    ActuatorControlRange = actuator_ctrlrange: |m| 2 * m.nu,
    /// Lower and upper limits of the actuators' forces, `[actuators, 2]`.
    ActuatorForceRange = actuator_forcerange: |m| 2 * m.nu,
    /// Acceleration that a unit force of each actuator causes in the initial pose, `[actuators]`.
    ActuatorAcceleration = actuator_acc0: |m| m.nu,
    /// Lengths of actuators in the initial pose, `[actuators]`.
    ActuatorLength = actuator_length0: |m| m.nu,
    /// Stiffness of tendons, `[tendons]`.
    TendonStiffness = tendon_stiffness: |m| m.ntendon,
    /// Damping of tendons, `[tendons]`.
    TendonDamping = tendon_damping: |m| m.ntendon,
    /// Lengths of tendons in the initial pose, `[tendons]`.
    TendonLength = tendon_length0: |m| m.ntendon,
    /// Inverse inertia of tendons in the initial pose, `[tendons]`.
    TendonInvWeight = tendon_invweight0: |m| m.ntendon,
    /// Generalised positions of keyframes, `[keyframes, n_q]`.
    KeyPositions = key_qpos: |m| m.nkey * m.nq,
    /// Generalised velocities of keyframes, `[keyframes, n_v]`.
    KeyVelocities = key_qvel: |m| m.nkey * m.nv,
}

/// The fields with masses, inertias and friction, and all fields that mj_setConst derives from masses and inertias.
pub(crate) const CONSTANTS: [ModelField; 9] = [
    ModelField::BodyMass,
    ModelField::BodyInertia,
    ModelField::GeomFriction,
    ModelField::BodySubtreeMass,
    ModelField::BodyInvWeight,
    ModelField::DofInvWeight,
    ModelField::DofInertia,
    ModelField::ActuatorAcceleration,
    ModelField::Statistic,
];

impl ModelField {
    /// The fields that [`Simulation::set_const`](crate::Simulation::set_const) derives from other fields and that
    /// affect the physics.
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
    /// An integer array of a model.
    Index: i32, {
        /// Index of each body's parent body, `[bodies]`.
        BodyParent = body_parentid: |m| m.nbody,
        /// Index of the body to which each body is rigidly attached, `[bodies]`. It is the body's own index if the body
        /// can move relative to its parent. 0 is the world.
        BodyWeld = body_weldid: |m| m.nbody,
        /// Types of joints, `[joints]`: 0 free, 1 ball, 2 slide, 3 hinge.
        JointType = jnt_type: |m| m.njnt,
        /// Index in `qpos` of each joint's first position, `[joints]`.
        JointPosition = jnt_qposadr: |m| m.njnt,
        /// Index in `qvel` of each joint's first velocity, `[joints]`.
        JointVelocity = jnt_dofadr: |m| m.njnt,
        /// Index of each joint's body, `[joints]`.
        JointBody = jnt_bodyid: |m| m.njnt,
        /// Types of geoms, `[geoms]`, as in MuJoCo's `mjtGeom`: 2 sphere, 3 capsule, 5 cylinder, 7 mesh.
        GeomType = geom_type: |m| m.ngeom,
        /// Index of each geom's body, `[geoms]`.
        GeomBody = geom_bodyid: |m| m.ngeom,
        /// Contact types of geoms, `[geoms]`, as bits. Two geoms can touch if the contact type of one and the contact
        /// affinity of the other have a bit in common.
        GeomContactType = geom_contype: |m| m.ngeom,
        /// Contact affinities of geoms, `[geoms]`, as bits that are compared with contact types, see
        /// [`Index::GeomContactType`].
        GeomContactAffinity = geom_conaffinity: |m| m.ngeom,
        /// Priorities of geoms, `[geoms]`. The geom of higher priority determines the parameters of a contact.
        GeomPriority = geom_priority: |m| m.ngeom,
        /// Dimensions of the contacts of geoms, `[geoms]`: 1 frictionless, 3 with sliding friction, 4 also with
        /// torsional friction, 6 also with rolling friction.
        GeomContactDimension = geom_condim: |m| m.ngeom,
        /// Index of the first geom of each pair that the model declares, `[pairs]`.
        PairGeom1 = pair_geom1: |m| m.npair,
        /// Index of the second geom of each pair that the model declares, `[pairs]`.
        PairGeom2 = pair_geom2: |m| m.npair,
        /// Dimension of the contact of each pair of geoms that the model declares, `[pairs]`.
        PairContactDimension = pair_dim: |m| m.npair,
        /// Types of the actuators' internal dynamics, `[actuators]`; 0 is none.
        ActuatorDynamics = actuator_dyntype: |m| m.nu,
        /// Types of the actuators' gains, `[actuators]`; 0 is a fixed gain.
        ActuatorGainType = actuator_gaintype: |m| m.nu,
        /// Types of the actuators' biases, `[actuators]`: 0 none, 1 affine.
        ActuatorBiasType = actuator_biastype: |m| m.nu,
        /// Types of the actuators' transmissions, `[actuators]`: 0 to a joint, 1 to a joint in its parent's frame.
        /// Other types act on elements that are not joints.
        ActuatorTransmission = actuator_trntype: |m| m.nu,
        /// Indices of the elements on which each actuator acts, `[actuators, 2]`.
        ActuatorTarget = actuator_trnid: |m| 2 * m.nu,
        /// Index in the sensor data of each sensor's first value, `[sensors]`.
        SensorAddress = sensor_adr: |m| m.nsensor,
        /// Number of values that each sensor writes to the sensor data, `[sensors]`.
        SensorDimension = sensor_dim: |m| m.nsensor,
    }
}

model_arrays! {
    /// An array of flags of a model, 0 or 1.
    Flags: u8, {
        /// Whether joints have limits, `[joints]`.
        JointLimited = jnt_limited: |m| m.njnt,
        /// Whether the actuators' controls have limits, `[actuators]`.
        ActuatorControlLimited = actuator_ctrllimited: |m| m.nu,
        /// Whether the actuators' forces have limits, `[actuators]`.
        ActuatorForceLimited = actuator_forcelimited: |m| m.nu,
    }
}

/// The integer options of a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Options {
    /// The numerical integrator: 0 Euler, 1 RK4, 2 implicit.
    pub integrator: i32,
    /// The pairs of geoms that are checked for collisions: 0 all, 1 only pairs that the model declares, 2 only pairs
    /// that are found by their contact types.
    pub collision: i32,
    /// The disabled parts of the physics, as bits of MuJoCo's `mjtDisableBit`.
    pub disable_flags: i32,
    /// The enabled additional parts of the physics, as bits of MuJoCo's `mjtEnableBit`.
    pub enable_flags: i32,
}

impl Options {
    /// The bit of [`Options::disable_flags`] that disables all constraints.
    pub const DISABLE_CONSTRAINT: i32 = 1;
    /// The bit of [`Options::disable_flags`] that disables dry friction of joints and tendons.
    pub const DISABLE_FRICTION_LOSS: i32 = 1 << 2;
    /// The bit of [`Options::disable_flags`] that disables the limits of joints and tendons.
    pub const DISABLE_LIMIT: i32 = 1 << 3;
    /// The bit of [`Options::disable_flags`] that disables contacts.
    pub const DISABLE_CONTACT: i32 = 1 << 4;
    /// The bit of [`Options::disable_flags`] that disables springs, dampers and fluid forces.
    pub const DISABLE_PASSIVE: i32 = 1 << 5;
    /// The bit of [`Options::disable_flags`] that disables gravity.
    pub const DISABLE_GRAVITY: i32 = 1 << 6;
    /// The bit of [`Options::disable_flags`] that disables all actuators.
    pub const DISABLE_ACTUATION: i32 = 1 << 10;
}

macro_rules! data_arrays {
    ($($(#[$doc:meta])* $field:ident = $raw:ident: $length:expr,)*) => {
        /// An array of a simulation: the state, or a quantity that MuJoCo computes.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        pub enum DataField {
            $($(#[$doc])* $field,)*
        }

        impl DataField {
            /// A pointer to the first element of the array in the data `d` of the model `m`, and the number of
            /// elements.
            pub(crate) fn pointer_and_length(self, d: &sys::mjData, m: &sys::mjModel) -> (*mut f64, usize) {
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
    /// Generalised positions, `[n_q]`, in m and rad. Orientations of free and ball joints are unit quaternions.
    Positions = qpos: |m| m.nq,
    /// Generalised velocities, `[n_v]`, in m/s and rad/s.
    Velocities = qvel: |m| m.nv,
    /// Controls of actuators, `[actuators]`.
    Controls = ctrl: |m| m.nu,
    /// Activations, the state of actuators with internal dynamics, `[n_act]`.
    Activations = act: |m| m.na,
    /// Origins of the bodies' frames in m, world frame, `[bodies, 3]`.
    BodyPositions = xpos: |m| 3 * m.nbody,
    /// Rotation matrices from the bodies' frames to the world frame, row-major, `[bodies, 9]`.
    BodyRotations = xmat: |m| 9 * m.nbody,
    /// Centres of mass of bodies in m, world frame, `[bodies, 3]`.
    BodyCentres = xipos: |m| 3 * m.nbody,
    /// Positions of geoms in m, world frame, `[geoms, 3]`.
    GeomPositions = geom_xpos: |m| 3 * m.ngeom,
    /// Positions of sites in m, world frame, `[sites, 3]`.
    SitePositions = site_xpos: |m| 3 * m.nsite,
    /// Inertia of each body about the centre of mass of its kinematic tree, `[bodies, 10]`: six elements of the inertia
    /// matrix in kg m², the mass times the offset in kg m, and the mass in kg.
    BodyInertias = cinert: |m| 10 * m.nbody,
    /// Velocity of each body about the centre of mass of its kinematic tree, `[bodies, 6]`: angular in rad/s, then
    /// linear in m/s.
    BodyVelocities = cvel: |m| 6 * m.nbody,
    /// External force on each body about the centre of mass of its kinematic tree, `[bodies, 6]`: torque in N m, then
    /// force in N.
    BodyExternalForces = cfrc_ext: |m| 6 * m.nbody,
    /// Total force of the actuators on each degree of freedom, `[dofs]`, in N or N m.
    DofActuation = qfrc_actuator: |m| m.nv,
    /// Total force of the constraints on each degree of freedom, `[dofs]`, in N or N m.
    DofConstraint = qfrc_constraint: |m| m.nv,
    /// Force of each actuator, `[actuators]`.
    ActuatorForces = actuator_force: |m| m.nu,
    /// The numbers of all sensors, one sensor after the other.
    Sensors = sensordata: |m| m.nsensordata,
}
