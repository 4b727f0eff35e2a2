//! Numbers -> SVG that stands in the report: curves, the trajectory from above and from the side, bars.
//!
//! Colours come from the classes of `report.css`, so that charts follow the light or dark page.

use glam::{DVec2, DVec3};
use maud::{Markup, html};

use crate::eval::numbers::number;
use crate::eval::trajectory::TimedPose;
use splat_types::transform::Rigid;

/// More points than pixels only make the file larger.
const MAX_CURVE_POINTS: usize = 400;
const MAX_PATH_POINTS: usize = 2000;

/// One value over the steps of a run.
#[derive(Debug, Clone, Copy)]
pub struct Curve<'a> {
    pub title: &'a str,
    pub unit: &'a str,
    /// (step, value) in order of steps.
    pub points: &'a [(u64, f64)],
    /// The axis begins at 0, so that heights compare; else at the smallest value.
    pub from_zero: bool,
}

/// The paths that a trajectory plot shows, all in the map frame.
#[derive(Debug, Clone, Copy)]
pub struct Paths<'a> {
    pub keyframes: &'a [TimedPose],
    pub frames: &'a [TimedPose],
    pub reference: &'a [Rigid],
}

/// Where the plot looks from; the map frame is that of a camera: x right, y down, z forward.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum View {
    Above,
    Side,
}

/// A line chart; `None` when there are fewer than two finite values.
pub fn curve_chart(curve: &Curve<'_>) -> Option<Markup> {
    let points: Vec<(f64, f64)> = curve
        .points
        .iter()
        .filter(|(_, value)| value.is_finite())
        .map(|&(step, value)| (step as f64, value))
        .collect();
    let points = subsampled(&points, MAX_CURVE_POINTS);
    let (first, last) = (points.first()?, points.last()?);
    if first.0 >= last.0 {
        return None;
    }
    let low = points
        .iter()
        .map(|point| point.1)
        .fold(f64::INFINITY, f64::min);
    let high = points
        .iter()
        .map(|point| point.1)
        .fold(f64::NEG_INFINITY, f64::max);
    let plot = Frame {
        x: Axis::new(first.0, last.0, 6),
        y: Axis::new(if curve.from_zero { low.min(0.0) } else { low }, high, 5).widened(),
        left: 52.0,
        top: 12.0,
        width: 450.0,
        height: 230.0,
    };
    let line = polyline(points.iter().map(|&(x, y)| plot.at(x, y)));
    let (end_x, end_y) = plot.at(last.0, last.1);
    let end = format!(
        "{}{}",
        number(last.1),
        if curve.unit.is_empty() {
            String::new()
        } else {
            format!(" {}", curve.unit)
        }
    );
    let label = format!(
        "{}: from {} to {} over {} steps",
        curve.title,
        number(first.1),
        number(last.1),
        last.0 - first.0
    );
    let label_y = (end_y - 8.0).max(plot.top + 10.0);
    Some(html! {
        svg viewBox="0 0 520 292" role="img" aria-label=(label) {
            (plot.grid())
            text.axis x=(plot.left + plot.width / 2.0) y="286" text-anchor="middle" { "step" }
            polyline.line.a points=(line) {}
            circle.dot.a cx=(px(end_x)) cy=(px(end_y)) r="3.5" {}
            text.value x=(px(end_x)) y=(px(label_y)) text-anchor="end" { (end) }
        }
    })
}

/// The path of the camera; `None` when there is nothing to show.
pub fn trajectory_chart(paths: &Paths<'_>, view: View) -> Option<Markup> {
    let flat = |point: DVec3| match view {
        View::Above => DVec2::new(point.x, point.z),
        View::Side => DVec2::new(point.z, -point.y),
    };
    let places = |poses: &[TimedPose]| {
        poses
            .iter()
            .map(|timed| flat(timed.pose.translation))
            .filter(|p| p.is_finite())
            .collect()
    };
    let keyframes: Vec<DVec2> = places(paths.keyframes);
    let frames: Vec<DVec2> = places(paths.frames);
    let reference: Vec<DVec2> = paths
        .reference
        .iter()
        .map(|pose| flat(pose.translation))
        .filter(|p| p.is_finite())
        .collect();
    let plot =
        Frame::with_equal_scales(keyframes.iter().chain(&frames).chain(&reference).copied())?;
    let place = |point: &DVec2| plot.at(point.x, point.y);
    let path = |points: &[DVec2]| polyline(subsampled(points, MAX_PATH_POINTS).iter().map(place));
    let (across, up, name) = match view {
        View::Above => ("x (right)", "z (forward)", "seen from above"),
        View::Side => ("z (forward)", "up (-y)", "seen from the side"),
    };
    let forward = |timed: &TimedPose| flat(timed.pose.rotation * DVec3::Z) - flat(DVec3::ZERO);
    let dots = subsampled(paths.keyframes, MAX_PATH_POINTS);
    Some(html! {
        svg viewBox="0 0 520 432" role="img" aria-label=(format!("camera path {name}: {} keyframes", keyframes.len())) {
            (plot.grid())
            text.axis x=(plot.left + plot.width / 2.0) y="426" text-anchor="middle" { (across) }
            text.axis transform=(format!("translate(12 {}) rotate(-90)", plot.top + plot.height / 2.0)) text-anchor="middle" { (up) }
            @if reference.len() > 1 { polyline.line.b points=(path(&reference)) {} }
            @if frames.len() > 1 { polyline.line.thin points=(path(&frames)) {} }
            @else if keyframes.len() > 1 { polyline.line.thin points=(path(&keyframes)) {} }
            @for timed in &dots {
                @let (x, y) = place(&flat(timed.pose.translation));
                @let orientation = forward(timed) * 11.0;
                @if x.is_finite() && y.is_finite() && orientation.is_finite() {
                    line.orientation x1=(px(x)) y1=(px(y)) x2=(px(x + orientation.x)) y2=(px(y - orientation.y)) {}
                    circle.dot.a cx=(px(x)) cy=(px(y)) r="2.8" { title { (timed.stamp) " s" } }
                }
            }
            @if let Some(start) = keyframes.first() {
                @let (x, y) = place(start);
                circle.start cx=(px(x)) cy=(px(y)) r="6.5" {}
                text.value x=(px(x + 10.0)) y=(px(y - 8.0)) { "start" }
            }
        }
    })
}

/// Bars as shares of `whole`: (name, value, text).
pub fn bars(rows: &[(&str, f64, String)], whole: f64) -> Markup {
    let share = |value: f64| {
        if whole > 0.0 && value.is_finite() {
            (100.0 * value / whole).clamp(0.0, 100.0)
        } else {
            0.0
        }
    };
    html! {
        div.bars {
            @for (name, value, text) in rows {
                span.name { (name) }
                span.track { span.fill style=(format!("width:{:.2}%", share(*value))) {} }
                span.num { (text) }
            }
        }
    }
}

/// A range of values with round ticks.
struct Axis {
    min: f64,
    max: f64,
    step: f64,
}

impl Axis {
    fn new(min: f64, max: f64, n_ticks: usize) -> Self {
        // A flat curve still needs a range around it, one that survives rounding next to large values.
        let smallest = 1e-6 * min.abs().max(max.abs()).max(1e-6);
        let (min, max) = if max - min < smallest {
            (min - smallest, max + smallest)
        } else {
            (min, max)
        };
        let rough = (max - min) / n_ticks as f64;
        let power = 10f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0]
            .map(|factor| factor * power)
            .into_iter()
            .find(|step| *step >= rough * 0.999);
        Self {
            min,
            max,
            step: step.unwrap_or(10.0 * power),
        }
    }

    /// Both ends on a tick.
    fn widened(self) -> Self {
        let (min, max) = (
            (self.min / self.step).floor() * self.step,
            (self.max / self.step).ceil() * self.step,
        );
        Self { min, max, ..self }
    }

    fn ticks(&self) -> Vec<f64> {
        let first = (self.min / self.step - 1e-6).ceil();
        // Bounded whatever the numbers are.
        (0..20)
            .map(|ix| (first + f64::from(ix)) * self.step)
            .take_while(|tick| *tick <= self.max + 1e-6 * self.step)
            .collect()
    }

    fn label(&self, tick: f64) -> String {
        if !(1e-4..1e7).contains(&self.step) && tick != 0.0 {
            return format!("{tick:.1e}");
        }
        let decimals = (-self.step.log10().floor()).max(0.0) as usize;
        // Adding zero turns -0 into 0.
        format!(
            "{:.decimals$}",
            (tick / self.step).round() * self.step + 0.0
        )
    }

    fn share(&self, value: f64) -> f64 {
        (value - self.min) / (self.max - self.min)
    }
}

/// The plotting area in SVG units, with what its edges stand for.
struct Frame {
    x: Axis,
    y: Axis,
    left: f64,
    top: f64,
    width: f64,
    height: f64,
}

impl Frame {
    /// Fits all points, one map unit as long on both axes.
    fn with_equal_scales(points: impl Iterator<Item = DVec2> + Clone) -> Option<Self> {
        let (left, top, width, height) = (62.0, 10.0, 446.0, 370.0);
        points.clone().next()?;
        let min = points.clone().fold(DVec2::INFINITY, DVec2::min);
        let max = points.fold(DVec2::NEG_INFINITY, DVec2::max);
        let (centre, size) = ((min + max) / 2.0, (max - min) * 1.12);
        let smallest = 1e-3 * centre.abs().max_element().max(1e-6);
        let unit_per_px = (size.x / width).max(size.y / height).max(smallest / height);
        let half = DVec2::new(width, height) * unit_per_px / 2.0;
        let x = Axis::new(centre.x - half.x, centre.x + half.x, 7);
        let y = Axis::new(centre.y - half.y, centre.y + half.y, 6);
        Some(Self {
            x,
            y,
            left,
            top,
            width,
            height,
        })
    }

    fn at(&self, x: f64, y: f64) -> (f64, f64) {
        (
            self.left + self.width * self.x.share(x),
            self.top + self.height * (1.0 - self.y.share(y)),
        )
    }

    fn grid(&self) -> Markup {
        let (right, bottom) = (self.left + self.width, self.top + self.height);
        html! {
            @for tick in self.y.ticks() {
                @let y = self.at(self.x.min, tick).1;
                line.grid x1=(px(self.left)) x2=(px(right)) y1=(px(y)) y2=(px(y)) {}
                text.tick x=(px(self.left - 8.0)) y=(px(y + 4.0)) text-anchor="end" { (self.y.label(tick)) }
            }
            @for tick in self.x.ticks() {
                @let x = self.at(tick, self.y.min).0;
                line.grid x1=(px(x)) x2=(px(x)) y1=(px(self.top)) y2=(px(bottom)) {}
                text.tick x=(px(x)) y=(px(bottom + 17.0)) text-anchor="middle" { (self.x.label(tick)) }
            }
        }
    }
}

fn polyline(points: impl Iterator<Item = (f64, f64)>) -> String {
    let points: Vec<String> = points.map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
    points.join(" ")
}

/// Evenly picked, first and last among them.
fn subsampled<T: Clone>(points: &[T], max: usize) -> Vec<T> {
    if points.len() <= max {
        return points.to_vec();
    }
    (0..max)
        .map(|ix| points[ix * (points.len() - 1) / (max - 1)].clone())
        .collect()
}

/// A tenth of an SVG unit is finer than the eye.
fn px(value: f64) -> String {
    format!("{value:.1}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_few_for_any_range() {
        for (min, max) in [
            (0.0, 1.0),
            (-3.3, 18.2),
            (1e-9, 2e-9),
            (5.0, 5.0),
            (0.0, 0.0),
            (1e11, 1e11 + 1.0),
            (-1e300, 1e300),
        ] {
            let axis = Axis::new(min, max, 6).widened();
            let ticks = axis.ticks();
            assert!((1..=20).contains(&ticks.len()), "{min} {max}: {ticks:?}");
            assert!(
                axis.min <= min && axis.max >= max,
                "{min} {max}: {} {}",
                axis.min,
                axis.max
            );
        }
        let labels: Vec<String> = Axis::new(0.0, 0.4, 4)
            .ticks()
            .iter()
            .map(|t| Axis::new(0.0, 0.4, 4).label(*t))
            .collect();
        assert_eq!(labels, ["0.0", "0.1", "0.2", "0.3", "0.4"]);
    }

    #[test]
    fn a_curve_without_two_finite_values_is_no_chart() {
        let chart = |points: &[(u64, f64)]| {
            curve_chart(&Curve {
                title: "loss",
                unit: "",
                points,
                from_zero: true,
            })
            .is_some()
        };
        assert!(!chart(&[]) && !chart(&[(5, 1.0)]) && !chart(&[(0, f64::NAN), (9, 1.0)]));
        assert!(chart(&[(0, 2.0), (9, 1.0)]));
    }
}
