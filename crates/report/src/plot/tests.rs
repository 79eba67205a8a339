use std::collections::HashSet;

use rstest::rstest;

use super::canvas::{INSIDE, LineStyle, text_width, wrapped};
use super::panels::{PanelLine, PanelPoint, PlotPanel};
use super::*;
use crate::fixture;

#[test]
fn lines_differ() {
    let look = |LineStyle { colour: RGBColor(r, g, b), dashes, .. }| (r, g, b, dashes);
    let styles: HashSet<_> = (0..10).map(|i| look(LineStyle::nth(i))).collect();
    assert_eq!(styles.len(), 10, "as many as the paper has methods");
}

#[test]
fn a_text_is_broken_where_a_line_ends() {
    load_font().unwrap();
    let lines = wrapped("a line that is much too long for a picture as wide as a column of a printed page is", INSIDE);
    assert!(lines.len() == 2 && lines.iter().all(|line| text_width(line) <= INSIDE), "{lines:?}");
    assert_eq!(wrapped(" one\n two ", INSIDE), ["one two"]);
    assert_eq!(wrapped("extraordinarily", 10.0), ["extraordinarily"]);
    let width = text_width("trained on D, seed");
    assert_eq!(wrapped("trained on D, seed 1", width), ["trained on D,", "seed 1"]);
    assert_eq!(wrapped("of 1 000 episodes", 10.0), ["of 1", "000", "episodes"]);
    // DejaVu's digits are 0.636 em wide.
    assert!((text_width("0000000000") / 10.0 - 0.636 * 14.6).abs() < 0.2, "{}", text_width("0000000000"));
}

/// Returns an SVG of each kind of picture.
fn pictures() -> Vec<String> {
    let point = |x: f64| PanelPoint { x, y: x, low: x - 5.0, high: x + 5.0 };
    let panel = PlotPanel {
        caption: "trained on D".into(),
        x_name: "episodes".into(),
        x: 0.0..100.0,
        y_name: "success rate, %".into(),
        y: panels::RATES,
        lines: vec![PanelLine { index: 0, points: vec![point(10.0), point(90.0)] }],
    };
    let panels = Panels {
        title: "CartPole: success rate while training".into(),
        panels: vec![panel.clone(), panel],
        legend: vec!["ppo ff".into(), "rl2-ppo rc N=5 (paper, sees the parameters)".into()],
        note: "lines: means over runs; bands: standard deviation".into(),
    };
    let heatmap = fixture::heatmap(3, |mass, length| (-900.0 * mass, 60.0 * length));
    let column =
        |name: &str| HeatmapColumn { caption: format!("trained on {name}, 2 runs"), content: Ok(heatmap.clone()) };
    let heatmaps = HeatmapPanels {
        title: vec!["Pendulum, ppo ff".into()],
        axes: heatmap.axes.clone(),
        returns: -1600.0..-200.0,
        columns: ["D", "R", "E"].map(column).into(),
    };
    vec![svg(&panels).unwrap(), svg(&heatmaps).unwrap(), svg(&intervals::tests::example()).unwrap()]
}

#[test]
fn a_line_of_one_point_is_seen() {
    let panel = |lines: Vec<PanelLine>| PlotPanel {
        caption: String::new(),
        x_name: "mass, kg".into(),
        x: 0.0..1.0,
        y_name: "success rate, %".into(),
        y: panels::RATES,
        lines,
    };
    let drawn = |lines| {
        svg(&Panels {
            title: String::new(),
            panels: vec![panel(lines)],
            legend: vec!["a2c ff".into()],
            note: String::new(),
        })
        .unwrap()
    };
    let point = |x, y| PanelPoint { x, y, low: y - 10.0, high: y + 10.0 };
    assert_eq!(drawn(Vec::new()).matches("<circle").count(), 0);
    let one = drawn(vec![PanelLine { index: 0, points: vec![point(0.1, 40.0)] }]);
    assert_eq!(one.matches("<circle").count(), 1, "{one}");
    let two = drawn(vec![PanelLine { index: 0, points: vec![point(0.1, 40.0), point(0.2, 40.0)] }]);
    assert_eq!(two.matches("<circle").count(), 0);
}

fn attribute<'a>(element: &'a str, name: &str) -> Option<&'a str> {
    element.split_once(&format!(" {name}=\""))?.1.split_once('"').map(|(value, _)| value)
}

/// The font sizes hold for pictures that are printed 85 mm wide, which is 241 pt.
#[test]
fn texts_have_nine_points_and_stay_inside() {
    for picture in pictures() {
        let view: Vec<f64> =
            attribute(&picture, "viewBox").unwrap().split(' ').map(|number| number.parse().unwrap()).collect();
        assert_eq!(attribute(&picture, "width"), Some(WIDTH.to_string().as_str()));
        let texts: Vec<&str> = picture.split("<text").skip(1).collect();
        assert!(texts.len() > 10);
        for text in texts {
            let size: f64 = attribute(text, "font-size").unwrap().parse().unwrap();
            assert!(size / view[2] * 85.0 / 25.4 * 72.0 >= 9.0, "{text}");
            let [x, y] = ["x", "y"].map(|name| attribute(text, name).unwrap().parse::<f64>().unwrap());
            let written = text.split_once('>').unwrap().1.split_once("</text>").unwrap().0.trim();
            let width = text_width(written) * f64::from(SVG_SCALE);
            let before = match attribute(text, "text-anchor") {
                Some("start") => 0.0,
                Some("middle") => width / 2.0,
                _ => width,
            };
            let (along, length) = if text.contains("rotate(270") { (y, view[3]) } else { (x, view[2]) };
            assert!(along - before >= 0.0 && along - before + width <= length, "{text}");
        }
    }
}

/// On a dark page, `style.css` replaces some colours of a picture. The SVG writes these colours in the form that the
/// selectors in `style.css` expect.
#[rstest]
#[case("[fill=\"#FFFFFF\"]", "fill=\"#FFFFFF\"")]
#[case("[fill=\"#222222\"]", "fill=\"#222222\"")]
#[case("[stroke=\"#222222\"]", "stroke=\"#222222\"")]
#[case("[stroke=\"#E1E1E1\"]", "stroke=\"#E1E1E1\"")]
fn a_dark_page_knows_the_colours_of_paper_ink_and_grid(#[case] selector: &str, #[case] written: &str) {
    assert!(include_str!("../report/style.css").contains(selector), "{selector}");
    assert!(pictures()[0].contains(written), "{written}");
}
