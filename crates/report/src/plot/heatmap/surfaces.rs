//! Merges the rectangles of heatmaps in an SVG. plotters writes an element for each rectangle: ten thousand elements, a
//! megabyte, for a picture of six heatmaps. If such a picture is scaled, the background also shows as thin lines
//! between rectangles. One path for each colour takes a tenth of the bytes, and leaves no such lines.

use std::collections::BTreeMap;

/// Merges each sequence of successive filled rectangles in `svg` into one path per colour. The rectangles of a sequence
/// must not overlap.
pub(super) fn as_paths(svg: &str) -> String {
    let mut shown = String::new();
    let mut surface: BTreeMap<&str, String> = BTreeMap::new();
    for line in svg.split_inclusive('\n') {
        match Rectangle::parse(line) {
            Some(Rectangle { colour, x, y, width, height }) => {
                // `z` closes the rectangle back to its start.
                let path = surface.entry(colour).or_default();
                path.push_str(&format!("M{x} {y}h{width}v{height}h-{width}z"));
            }
            None => {
                flush(&mut surface, &mut shown);
                shown.push_str(line);
            }
        }
    }
    flush(&mut surface, &mut shown);
    shown
}

/// Appends a path for each colour of `surface` to `shown`, and empties `surface`.
fn flush(surface: &mut BTreeMap<&str, String>, shown: &mut String) {
    for (colour, path) in std::mem::take(surface) {
        shown.push_str(&format!("<path fill=\"{colour}\" shape-rendering=\"crispEdges\" d=\"{path}\"/>\n"));
    }
}

/// A filled rectangle, as plotters writes it.
struct Rectangle<'a> {
    colour: &'a str,
    x: &'a str,
    y: &'a str,
    width: &'a str,
    height: &'a str,
}

impl<'a> Rectangle<'a> {
    /// Parses a line of the SVG. Returns `None` unless it is an opaque rectangle without outline.
    fn parse(line: &'a str) -> Option<Self> {
        let attributes = line.trim_end().strip_prefix("<rect ")?.strip_suffix("/>")?;
        let is_whole = attributes.contains("stroke=\"none\"") && attributes.contains("opacity=\"1\"");
        let value = |name: &str| {
            let (_, rest) = attributes.split_once(&format!("{name}=\""))?;
            Some(rest.split_once('"')?.0)
        };
        let rectangle = Self {
            colour: value("fill")?,
            x: value("x")?,
            y: value("y")?,
            width: value("width")?,
            height: value("height")?,
        };
        is_whole.then_some(rectangle)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbouring_rectangles_merge_by_colour() {
        let rect = |x: i32, colour: &str, stroke: &str| {
            format!(
                "<rect x=\"{x}\" y=\"7\" width=\"2\" height=\"3\" opacity=\"1\" fill=\"{colour}\" stroke=\"{stroke}\"/>\n"
            )
        };
        let (text, outline) = ("<text x=\"1\">\na &lt; b\n</text>\n", rect(1, "none", "#000000"));
        let svg = [
            "<svg>\n",
            &rect(0, "#BB0000", "none"),
            &rect(2, "#00AA00", "none"),
            &rect(4, "#BB0000", "none"),
            text,
            &rect(6, "#BB0000", "none"),
            &outline,
            "</svg>",
        ];
        let path =
            |colour: &str, d: &str| format!("<path fill=\"{colour}\" shape-rendering=\"crispEdges\" d=\"{d}\"/>\n");
        let expected = [
            "<svg>\n",
            &path("#00AA00", "M2 7h2v3h-2z"),
            &path("#BB0000", "M0 7h2v3h-2zM4 7h2v3h-2z"),
            text,
            &path("#BB0000", "M6 7h2v3h-2z"),
            &outline,
            "</svg>",
        ];
        assert_eq!(as_paths(&svg.concat()), expected.concat());
    }
}
