//! What a picture of an environment shows.

/// All that a drawing needs of an environment's state and parameters. Angles are in rad, lengths in m; numbers are
/// finite, but may be absurdly large.
#[derive(Debug, Clone, PartialEq)]
pub enum Pose {
    /// A cart on a track, and its pole.
    CartPole {
        /// The cart's position.
        position: f64,
        /// The pole's angle from upright, clockwise.
        angle: f64,
        /// From the hinge to the pole's middle.
        half_pole_length: f64,
        /// The cart's position at which an episode ends, on either side.
        position_limit: f64,
        /// The pole's angle at which an episode ends, on either side.
        angle_limit: f64,
    },
    /// A car between hills.
    MountainCar {
        /// The car's position, in `low` … `high`.
        position: f64,
        /// The left end of the road.
        low: f64,
        /// The right end of the road.
        high: f64,
        /// Where the flag is.
        goal: f64,
    },
    /// Two links that hang from a pivot.
    Acrobot {
        /// The first link's angle from hanging, and the second's from the first, anticlockwise.
        angles: [f64; 2],
        /// Of each link.
        link_length: f64,
        /// The height above the pivot that the tip has to reach.
        goal_height: f64,
    },
    /// A rod on a pivot.
    Pendulum {
        /// From upright, anticlockwise.
        angle: f64,
        /// Of the rod.
        length: f64,
        /// The angle from upright, on either side, within which the rod counts as held.
        upright: f64,
        /// The last step's torque as a share of the largest, in ±1, if a step led to this state.
        torque: Option<f64>,
    },
    /// A robot on a floor.
    #[cfg(feature = "mujoco")]
    Robot {
        /// The robot's name.
        name: &'static str,
        /// Its model, as MJCF.
        mjcf: &'static str,
        /// `[Q]`
        qpos: Vec<f64>,
    },
}
