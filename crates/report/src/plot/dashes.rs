//! Cuts dashed lines into dashes, with operations whose rounding is the same on every machine. plotters would use the C
//! library's `hypotf` instead. Its rounding depends on the library's version, and programs that use it need a newer
//! glibc than Debian 12 has.

/// Returns the dashes of the line through `points`, each as a list of points. The line starts with a full dash, and the
/// pattern continues around corners. `dash` and `gap` are lengths above 0, in the unit of the points.
pub(super) fn dashes(points: &[(f64, f64)], dash: f64, gap: f64) -> Vec<Vec<(f64, f64)>> {
    let mut done = Vec::new();
    let mut current: Vec<(f64, f64)> = points.iter().take(1).copied().collect();
    let (mut in_dash, mut left) = (true, dash);
    for ends in points.windows(2) {
        let ((x, y), (dx, dy)) = (ends[0], (ends[1].0 - ends[0].0, ends[1].1 - ends[0].1));
        let length = (dx * dx + dy * dy).sqrt();
        let mut walked = 0.0;
        while length - walked >= left {
            walked += left;
            current.push((x + dx * walked / length, y + dy * walked / length));
            if in_dash {
                done.push(std::mem::take(&mut current));
            }
            in_dash = !in_dash;
            left = if in_dash { dash } else { gap };
        }
        left -= length - walked;
        if in_dash {
            current.push(ends[1]);
        }
    }
    if current.len() > 1 {
        done.push(current);
    }
    done
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dashes_and_gaps_take_turns_around_corners() {
        let corner = [(0.0, 0.0), (10.0, 0.0), (10.0, 9.0)];
        let expected =
            [vec![(0.0, 0.0), (4.0, 0.0)], vec![(7.0, 0.0), (10.0, 0.0), (10.0, 1.0)], vec![(10.0, 4.0), (10.0, 8.0)]];
        assert_eq!(dashes(&corner, 4.0, 3.0), expected);
        assert_eq!(dashes(&corner, 100.0, 3.0), [corner]);
    }

    #[test]
    fn a_line_without_length_has_no_dashes_that_end() {
        assert_eq!(dashes(&[], 4.0, 3.0), Vec::<Vec<(f64, f64)>>::new());
        assert_eq!(dashes(&[(1.0, 1.0)], 4.0, 3.0), Vec::<Vec<(f64, f64)>>::new());
        assert_eq!(dashes(&[(1.0, 1.0), (1.0, 1.0)], 4.0, 3.0), [[(1.0, 1.0), (1.0, 1.0)]]);
    }
}
