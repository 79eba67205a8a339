//! The camera of a folder's pictures.

use super::{elements::Elements, error::Result, table::TomlTable};
use crate::scene::ModelView;
use perturb_mujoco::{ElementKind, Model, ModelField};

const PICTURE: &[&str] = &["camera", "look_at", "distance", "azimuth", "elevation", "follow"];
const AZIMUTH: f64 = 90.0;
const ELEVATION: f64 = -15.0;

/// Reads the camera from the TOML table `picture`. Without a table, pictures show the whole model from the side.
pub(super) fn view(table: Option<&TomlTable<'_>>, model: &Model, elements: &Elements) -> Result<ModelView> {
    // Entry 3 of the statistics is the model's extent, entries 4 to 6 are its centre.
    let statistic = model.field(ModelField::Statistic);
    let centre = std::array::from_fn(|i| statistic[4 + i]);
    let mut view = (centre, 1.5 * statistic[3], AZIMUTH, ELEVATION, None);
    if let Some(table) = table {
        table.only(PICTURE)?;
        if let Some(camera) = table.get("camera") {
            if let Some(other) = PICTURE[1..].iter().find(|key| table.has(key)) {
                return Err(table.error(format_args!("give either camera or {other}, not both")));
            }
            return Ok(ModelView::Camera(elements.find(ElementKind::Camera, &camera)?));
        }
        if let Some(value) = table.get("look_at") {
            view.0 = value.numbers()?.try_into().map_err(|_| value.error("expected three numbers: x, y and z in m"))?;
        }
        view.1 = table.number("distance")?.unwrap_or(view.1);
        view.2 = table.number("azimuth")?.unwrap_or(view.2);
        view.3 = table.number("elevation")?.unwrap_or(view.3);
        view.4 = table.get("follow").map(|value| elements.find(ElementKind::Body, &value)).transpose()?;
        if view.1 <= 0.0 {
            return Err(table.error(format_args!("distance is {}; expected more than 0 m", view.1)));
        }
    }
    let (look_at, distance, azimuth, elevation, followed) = view;
    Ok(ModelView::Placed { look_at, distance, azimuth, elevation, followed })
}
