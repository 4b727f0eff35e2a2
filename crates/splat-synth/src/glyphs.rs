//! A 5x7 letter set: (character, place in its box) -> ink.

use glam::Vec2;

use crate::noise::{edge, hash, visible};

const N_COLUMNS: i32 = 5;
const N_ROWS: i32 = 7;
/// Width and height of a letter's box in dots, gap included.
const BOX_DOTS: Vec2 = Vec2::new(6.0, 9.0);

/// Rows from the top, five bits each, leftmost dot highest.
#[rustfmt::skip]
const LETTERS: [[u8; 7]; 26] = [
    [14, 17, 17, 31, 17, 17, 17], [30, 17, 17, 30, 17, 17, 30], [14, 17, 16, 16, 16, 17, 14], [30, 17, 17, 17, 17, 17, 30],
    [31, 16, 16, 30, 16, 16, 31], [31, 16, 16, 30, 16, 16, 16], [14, 17, 16, 23, 17, 17, 15], [17, 17, 17, 31, 17, 17, 17],
    [14, 4, 4, 4, 4, 4, 14], [7, 2, 2, 2, 2, 18, 12], [17, 18, 20, 24, 20, 18, 17], [16, 16, 16, 16, 16, 16, 31],
    [17, 27, 21, 21, 17, 17, 17], [17, 25, 21, 19, 17, 17, 17], [14, 17, 17, 17, 17, 17, 14], [30, 17, 17, 30, 16, 16, 16],
    [14, 17, 17, 17, 21, 18, 13], [30, 17, 17, 30, 20, 18, 17], [15, 16, 16, 14, 1, 1, 30], [31, 4, 4, 4, 4, 4, 4],
    [17, 17, 17, 17, 17, 17, 14], [17, 17, 17, 17, 17, 10, 4], [17, 17, 17, 21, 21, 27, 17], [17, 17, 10, 4, 10, 17, 17],
    [17, 17, 10, 4, 4, 4, 4], [31, 1, 2, 4, 8, 16, 31],
];
#[rustfmt::skip]
const DIGITS: [[u8; 7]; 10] = [
    [14, 17, 19, 21, 25, 17, 14], [4, 12, 4, 4, 4, 4, 14], [14, 17, 1, 6, 8, 16, 31], [31, 2, 4, 2, 1, 17, 14],
    [2, 6, 10, 18, 31, 2, 2], [31, 16, 30, 1, 1, 17, 14], [6, 8, 16, 30, 17, 17, 14], [31, 1, 2, 4, 8, 8, 8],
    [14, 17, 17, 14, 17, 17, 14], [14, 17, 17, 15, 1, 2, 12],
];

fn rows(letter: char) -> [u8; 7] {
    match letter {
        'A'..='Z' => LETTERS[letter as usize - 'A' as usize],
        '0'..='9' => DIGITS[letter as usize - '0' as usize],
        _ => [0; 7],
    }
}

/// Ink of one letter at `at` in dots from the lower left of its box, corners of dots softened over a sample.
fn letter_ink(letter: char, at: Vec2, footprint: f32) -> f32 {
    let rows = rows(letter);
    let is_set = |column: i32, row: i32| {
        (0..N_COLUMNS).contains(&column)
            && (0..N_ROWS).contains(&row)
            && rows[(N_ROWS - 1 - row) as usize] >> (N_COLUMNS - 1 - column) & 1 == 1
    };
    let dot = at.floor();
    let (column, row) = (dot.x as i32, dot.y as i32 - 1);
    let inside = at - dot;
    // A sample covers at most this dot and the next one on either side.
    let mut ink = 0.0;
    for dy in -1..=1 {
        for dx in -1..=1 {
            if is_set(column + dx, row + dy) {
                let cover = |x: f32, d: i32| {
                    edge(d as f32, x, footprint.max(0.05))
                        - edge((d + 1) as f32, x, footprint.max(0.05))
                };
                ink += cover(inside.x, dx) * cover(inside.y, dy);
            }
        }
    }
    ink.clamp(0.0, 1.0)
}

/// One line of letters, centred on the origin, `height` metres high. Too small to read it becomes a grey bar.
pub(crate) fn line_ink(text: &str, at: Vec2, height: f32, footprint: f32) -> f32 {
    let dot = height / N_ROWS as f32;
    let n = text.len() as f32;
    let place = at / dot + Vec2::new(0.5 * n * BOX_DOTS.x, 0.5 * BOX_DOTS.y);
    if place.y < 0.0 || place.y >= BOX_DOTS.y || place.x < 0.0 || place.x >= n * BOX_DOTS.x {
        return 0.0;
    }
    let ix = (place.x / BOX_DOTS.x) as usize;
    let letter = text.as_bytes().get(ix).map_or(' ', |b| *b as char);
    let in_box = Vec2::new(place.x - ix as f32 * BOX_DOTS.x, place.y);
    faded(
        letter_ink(letter, in_box, footprint / dot),
        letter,
        dot,
        footprint,
    )
}

/// A column of words that nobody wrote: lines of `line_height`, `half_width` wide, ragged right.
pub(crate) fn column_ink(
    at: Vec2,
    half_width: f32,
    line_height: f32,
    seed: u32,
    footprint: f32,
) -> f32 {
    let dot = line_height / BOX_DOTS.y;
    let row = (at.y / line_height).floor();
    let line = hash(seed ^ (row as i32 as u32));
    let from_left = at.x + half_width;
    let ragged = half_width * (1.4 + 0.6 * crate::noise::pick(line, 1));
    let ends_paragraph = line.is_multiple_of(7);
    if from_left < 0.0 || from_left > ragged * if ends_paragraph { 0.4 } else { 1.0 } {
        return 0.0;
    }
    let column = (from_left / (dot * BOX_DOTS.x)).floor();
    let id = hash(line ^ (column as i32 as u32).wrapping_mul(31));
    if id.is_multiple_of(6) {
        return 0.0;
    }
    let letter = (b'A' + (id >> 8) as u8 % 26) as char;
    let in_box = Vec2::new(
        from_left - column * dot * BOX_DOTS.x,
        at.y - row * line_height,
    ) / dot;
    faded(
        letter_ink(letter, in_box, footprint / dot),
        letter,
        dot,
        footprint,
    )
}

fn faded(ink: f32, letter: char, dot: f32, footprint: f32) -> f32 {
    let mean = if letter == ' ' { 0.0 } else { 0.38 };
    mean + (ink - mean) * visible(3.0 * dot, footprint)
}
