//! A picture as a report's page shows it.

/// A picture as it is shown, or the place of one that is missing.
#[derive(Clone, Debug)]
pub struct Figure {
    /// Figures of one environment stand together.
    pub environment: String,
    /// What its files are called, without their endings.
    pub file: String,
    /// A few words for those who do not see it.
    pub name: String,
    /// What the picture shows, or why it is missing.
    pub caption: String,
    /// Complete in itself.
    pub picture: FigureData,
}

/// What is shown of a picture.
#[derive(Clone, Debug)]
pub enum FigureData {
    /// Both are complete in themselves.
    Svg {
        /// An SVG element.
        svg: String,
        /// The numbers that are drawn, as a file.
        csv: Vec<u8>,
    },
    /// There is none; the caption says why.
    Missing,
}
