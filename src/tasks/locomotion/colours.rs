//! The colours of the robots: red, green and blue, each 0 … 1.

pub const GREY: [f32; 3] = [0.36, 0.40, 0.44];
pub const BLUE: [f32; 3] = [0.0, 0.447, 0.698];
pub const SKY_BLUE: [f32; 3] = [0.337, 0.706, 0.914];
pub const ORANGE: [f32; 3] = [0.902, 0.624, 0.0];
pub const VERMILLION: [f32; 3] = [0.835, 0.369, 0.0];
