//! Pictures of a report's numbers, which are drawn for its page and as files of their own.

use super::{Figure, FigureData, Report};
use crate::Method;
use crate::plot::{Panels, PlotError, svg};

/// A picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// What it is of; empty if of all environments.
    pub environment: String,
    /// What its files are called, without their endings.
    pub file: String,
    /// A few words for those who do not see it.
    pub name: String,
    /// What it shows.
    pub caption: String,
    /// What is drawn.
    pub panels: Panels,
}

impl Picture {
    /// As the page shows it.
    pub(super) fn figure(&self) -> Result<Figure, PlotError> {
        let Self { environment, name, caption, panels, .. } = self.clone();
        Ok(Figure { environment, name, caption, picture: FigureData::Svg(svg(&panels)?) })
    }
}

impl Report<'_> {
    /// All of them: performance profiles, success over parameters and over the threshold, what settings do, as far as there
    /// are numbers.
    pub fn pictures(&self) -> Vec<Picture> {
        let profiles = self.profiles_picture().into_iter();
        let swept = self.parameter_pictures().into_iter().chain(self.threshold_pictures());
        profiles.chain(swept).chain(self.settings_pictures()).collect()
    }
}

/// The method's name in small letters, digits and hyphens.
pub(super) fn file_name(method: &Method) -> String {
    let name = method.to_string().to_lowercase();
    let words = name.split(|letter: char| !letter.is_ascii_alphanumeric()).filter(|word| !word.is_empty());
    words.collect::<Vec<_>>().join("-")
}
