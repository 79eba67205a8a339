//! A picture as a report's page shows it.

/// A picture on the page, or the note about a missing one.
#[derive(Clone, Debug)]
pub struct Figure {
    /// Figures of one environment stand together.
    pub environment: String,
    /// The names of the files, without extension.
    pub file: String,
    /// A few words for those who do not see it.
    pub name: String,
    /// The caption, or the reason why the picture is missing.
    pub caption: String,
    /// Complete in itself.
    pub picture: FigureData,
}

/// The content of a figure.
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
