//! The map from above, as a planner sees it: free and occupied ground, distances to obstacles, the way of the camera.

use std::io::Cursor;

use base64::Engine as _;
use glam::{DVec2, IVec2};
use image::{ImageFormat, Rgb, RgbImage};
use maud::{Markup, html};

use splat_volume::distance::signed_distances;
use splat_volume::grid::{Grid, OCCUPIED, UNKNOWN};

/// Longer side of the image, pixels; a cell has 2 to 8 of them.
const SIDE_PX: i32 = 1200;
const CELL_PX: [i32; 2] = [2, 8];
/// Cells around all that is known.
const MARGIN: i32 = 6;
/// Free ground is white from so many metres to an obstacle on.
const CLEAR: f64 = 0.8;
const UNKNOWN_COLOUR: [u8; 3] = [198, 201, 206];
const OCCUPIED_COLOUR: [u8; 3] = [38, 42, 51];
/// Beside an obstacle.
const NEAR_COLOUR: [u8; 3] = [255, 196, 140];
const PATH_COLOUR: [u8; 3] = [35, 105, 205];
const FIRST_COLOUR: [u8; 3] = [20, 150, 80];
const LAST_COLOUR: [u8; 3] = [205, 45, 55];

/// What is drawn.
#[derive(Debug, Clone)]
pub struct TopView {
    pub grid: Grid,
    /// Of the cameras in the frame of the grid, metres, in order of time.
    pub path: Vec<DVec2>,
    /// `false`: nobody knows how long a metre is.
    pub is_metric: bool,
}

/// Nothing where no cell is known.
pub(crate) fn section(view: &TopView) -> image::ImageResult<Markup> {
    let Some(image) = drawn(view) else {
        return Ok(html! {});
    };
    let mut png = Vec::new();
    image.write_to(&mut Cursor::new(&mut png), ImageFormat::Png)?;
    let data = base64::engine::general_purpose::STANDARD.encode(png);
    let cells = &view.grid.cells;
    let area = |wanted: i8| {
        let n = cells.iter().filter(|cell| **cell == wanted).count();
        n as f64 * view.grid.resolution * view.grid.resolution
    };
    let (free, occupied) = (area(0), area(OCCUPIED));
    Ok(html! {
        section.card {
            h2 { "From above" }
            img alt="Occupancy grid with the way of the camera" src=(format!("data:image/png;base64,{data}")) style="max-width: 100%; image-rendering: pixelated";
            p {
                "White: free ground, orange near obstacles. Black: occupied. Grey: not seen. Blue: the camera, from green to red. "
                @if view.is_metric {
                    (format!("{free:.1} m² are free, {occupied:.1} m² occupied; a cell is {:.0} cm wide.", 100.0 * view.grid.resolution))
                } @else {
                    "The scale is unknown: drawn as if the middle of all that was seen was 2.5 m away."
                }
            }
        }
    })
}

fn drawn(view: &TopView) -> Option<RgbImage> {
    let grid = &view.grid;
    let (first, last) = grid.known()?;
    let (first, last) = (first - MARGIN, last + MARGIN);
    let size = last - first + 1;
    let px = (SIDE_PX / size.max_element()).clamp(CELL_PX[0], CELL_PX[1]);
    let distances = signed_distances(grid, CLEAR);
    let width = grid.extent.width as usize;
    let (w, h) = (size.x * px, size.y * px);
    let mut image = RgbImage::from_fn(w as u32, h as u32, |x, y| {
        // The highest y is on top.
        let cell = IVec2::new(x as i32 / px, size.y - 1 - y as i32 / px) + first;
        let at = cell - grid.extent.first;
        let is_inside = grid.cell(cell) != UNKNOWN;
        let distance = is_inside.then(|| distances[at.y as usize * width + at.x as usize]);
        Rgb(colour(grid.cell(cell), f64::from(distance.unwrap_or(0.0))))
    });
    let pixel = |p: &DVec2| {
        let at = *p / grid.resolution - first.as_dvec2();
        DVec2::new(at.x, f64::from(size.y) - at.y) * f64::from(px)
    };
    let path: Vec<DVec2> = view
        .path
        .iter()
        .filter(|p| p.is_finite())
        .map(pixel)
        .collect();
    for pair in path.windows(2) {
        let n = pair[0]
            .distance(pair[1])
            .ceil()
            .clamp(1.0, 4.0 * f64::from(SIDE_PX)) as u32;
        for step in 0..=n {
            let p = pair[0].lerp(pair[1], f64::from(step) / f64::from(n));
            dot(&mut image, p, 1.0, PATH_COLOUR);
        }
    }
    for (end, colour) in [(path.first(), FIRST_COLOUR), (path.last(), LAST_COLOUR)] {
        if let Some(p) = end {
            dot(&mut image, *p, 5.0, colour);
        }
    }
    Some(image)
}

fn colour(cell: i8, distance: f64) -> [u8; 3] {
    match cell {
        UNKNOWN => UNKNOWN_COLOUR,
        OCCUPIED => OCCUPIED_COLOUR,
        _ => {
            let share = (distance / CLEAR).clamp(0.0, 1.0);
            NEAR_COLOUR.map(|near| (f64::from(near) * (1.0 - share) + 255.0 * share) as u8)
        }
    }
}

fn dot(image: &mut RgbImage, middle: DVec2, radius: f64, colour: [u8; 3]) {
    let reach = radius.ceil() as i32;
    for y in -reach..=reach {
        for x in -reach..=reach {
            let at = middle.floor().as_ivec2() + IVec2::new(x, y);
            let is_inside = at.x >= 0
                && at.y >= 0
                && (at.x as u32) < image.width()
                && (at.y as u32) < image.height();
            if is_inside && f64::from(x * x + y * y) <= radius * radius {
                image.put_pixel(at.x as u32, at.y as u32, Rgb(colour));
            }
        }
    }
}
