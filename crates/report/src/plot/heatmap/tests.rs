use super::super::{PNG_SCALE, svg};
use super::*;
use crate::fixture;

fn panels(heatmaps: &[Heatmap]) -> HeatmapPanels {
    let (title, axes) = (vec!["Pendulum".to_owned()], heatmaps[0].axes.clone());
    let column = |heatmap: &Heatmap| HeatmapColumn { caption: "trained on D".into(), content: Ok(heatmap.clone()) };
    let returns = common_returns("Pendulum", heatmaps.iter());
    HeatmapPanels { title, axes, returns, columns: heatmaps.iter().map(column).collect() }
}

/// Returns the heatmaps' SVG paths that have rectangles of this width: the colour and the rest of the element.
fn surfaces(shown: &str, width: i32) -> Vec<(&str, &str)> {
    let lines = shown.lines().filter_map(|line| line.strip_prefix("<path fill=\"")?.split_once('"'));
    lines.filter(|(_, rest)| rest.contains(&format!("h{width}v"))).collect()
}

#[test]
fn perfect_and_worst_policies_have_the_end_colours() {
    for (figures, colour) in [((-120.0, 100.0), "#FDE725"), ((-1700.0, 0.0), "#440154")] {
        let panels = panels(&[fixture::heatmap(5, |_, _| figures)]);
        let shown = svg(&panels).unwrap();
        // All points have the same colour, so each of a heatmap's five rows is one rectangle, as wide as the panel.
        let whole_lines = surfaces(&shown, (panels.size().0 * 4.0).round() as i32);
        assert_eq!(whole_lines.len(), 2, "mean return and success");
        for (got, path) in whole_lines {
            assert_eq!((got, path.matches('M').count()), (colour, 5));
        }
    }
}

#[test]
fn a_point_has_the_colour_of_its_share_of_the_scale() {
    // On the scale from -1600 to -200, a return of -1250 is at a quarter, and -200 at the end.
    let heatmap = fixture::heatmap(2, |mass, length| {
        (if mass < 1.0 { -1250.0 } else { -200.0 }, if length > 1.0 { 75.0 } else { 0.0 })
    });
    let panels = panels(&[heatmap]);
    let shown = svg(&panels).unwrap();
    let colour = |share: f64| {
        let RGBColor(r, g, b) = viridis(share);
        format!("#{r:02X}{g:02X}{b:02X}")
    };
    let frame = panels.frame(0, 0.0);
    let half = (frame.width * 2.0).round() as i32;
    let left = (frame.left * 4.0).round() as i32;
    let path_of = |share: f64, width: i32| {
        let all = surfaces(&shown, width);
        all.into_iter().find(|(got, _)| *got == colour(share)).map(|(_, path)| path.to_owned())
    };
    // Small masses are on the left.
    assert!(path_of(0.25, half).unwrap().contains(&format!("M{left} ")));
    assert!(!path_of(1.0, half).unwrap().contains(&format!("M{left} ")));
    // Large lengths are at the top, over the whole width of the panel.
    assert_eq!(path_of(0.75, 2 * half).unwrap().matches('M').count(), 1);
}

#[test]
fn d_r_e_share_one_scale_and_whole_boxes() {
    let of = [-1600.0, -900.0, -200.0].map(|value| fixture::heatmap(4, |_, _| (value, 50.0)));
    let three = panels(&of);
    let tops: Vec<f64> = (0..3).map(|column| three.frame(column, 7.0).top).collect();
    assert_eq!((three.rows().count(), tops), (1, vec![7.0; 3]));
    assert!((0..2).all(|column| three.frame(column, 0.0).right() < three.frame(column + 1, 0.0).left));
    assert!(three.frame(2, 0.0).right() <= f64::from(WIDTH) - MARGIN);
    let shown = svg(&three).unwrap();
    for (name, boxes) in [("#C81E1E", 4), ("#FFFFFF", 1)] {
        // Each box in six panels and in the legend has four solid sides.
        let lines =
            shown.lines().filter(|line| line.contains("<polyline") && line.contains(&format!("stroke=\"{name}\"")));
        let core = lines.filter(|line| line.contains("stroke-width=\"8\"")).count();
        assert_eq!(core, 4 * (6 * boxes + 1), "{name}");
    }
    assert!(!shown.contains("dasharray"));
    assert_eq!(shown.matches("<circle").count(), 2 * (6 + 1), "the default, in two rings");
    for name in KEY {
        assert_eq!(shown.matches(name).count(), 1, "{name}");
    }
}

/// In a PNG, each pixel along the sides of a box has the colour of its inner line, and pixels beside it have the outer
/// colour.
#[test]
fn boxes_are_whole_in_a_png() {
    const SIZE: (u32, u32) = (60, 50);
    let mut pixels = vec![90; (3 * SIZE.0 * SIZE.1 * PNG_SCALE * PNG_SCALE) as usize];
    {
        let area =
            BitMapBackend::with_buffer(&mut pixels, (SIZE.0 * PNG_SCALE, SIZE.1 * PNG_SCALE)).into_drawing_area();
        PlotCanvas::new(&area, PNG_SCALE).unwrap().outline([(10.0, 10.0), (50.0, 40.0)], RANDOM).unwrap();
        area.present().unwrap();
    }
    let at = |x: u32, y: u32| {
        let start = (3 * (y * SIZE.0 * PNG_SCALE + x)) as usize;
        [pixels[start], pixels[start + 1], pixels[start + 2]]
    };
    let [left, top, right, bottom] = [10, 10, 50, 40].map(|side| side * PNG_SCALE);
    let along = (left..=right).flat_map(|x| [(x, top), (x, bottom)]);
    for (x, y) in along.chain((top..=bottom).flat_map(|y| [(left, y), (right, y)])) {
        assert_eq!(at(x, y), [255; 3], "{x}, {y}");
    }
    let outer = (left..=right).flat_map(|x| [(x, top - 5), (x, bottom + 5)]);
    for (x, y) in outer.chain((top..=bottom).flat_map(|y| [(left - 5, y), (right + 5, y)])) {
        assert_eq!(at(x, y), [0; 3], "{x}, {y}");
    }
}

#[test]
fn many_columns_have_several_rows_and_what_is_missing_says_so() {
    let mut panels = panels(&vec![fixture::heatmap(2, |_, _| (0.0, 0.0)); 7]);
    panels.columns[6].content =
        Err("no heatmap, since this training has no result yet; and why is a long story".into());
    panels.columns[5].content = Err("not made".into());
    assert_eq!(panels.rows().map(<[_]>::len).collect::<Vec<_>>(), [3, 3, 1]);
    let shown = svg(&panels).unwrap();
    assert_eq!((shown.matches("missing").count(), shown.matches("not made").count()), (2, 2));
}
