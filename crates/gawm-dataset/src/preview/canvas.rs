//! Pixels, lines and letters.

use font8x8::UnicodeFonts;
use gawm_image::Thumbnail;

/// Side of a letter in pixels.
pub(super) const LETTER: usize = 8;

/// A picture that is drawn on.
pub(super) struct Canvas {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) rgb: Vec<u8>,
}

impl Canvas {
    pub(super) fn new(width: usize, height: usize, colour: [u8; 3]) -> Canvas {
        Canvas { width, height, rgb: colour.repeat(width * height) }
    }

    fn set(&mut self, x: usize, y: usize, colour: [u8; 3]) {
        if x < self.width && y < self.height {
            let at = (y * self.width + x) * 3;
            self.rgb[at..at + 3].copy_from_slice(&colour);
        }
    }

    pub(super) fn fill(&mut self, x: usize, y: usize, width: usize, height: usize, colour: [u8; 3]) {
        for row in y..y + height {
            (x..x + width).for_each(|column| self.set(column, row, colour));
        }
    }

    /// Writes text; what does not fit into `width` pixels ends in dots. Letters that the font lacks are question marks.
    pub(super) fn text(
        &mut self,
        (x, y): (usize, usize),
        width: usize,
        scale: usize,
        text: &str,
        colour: [u8; 3],
    ) {
        let n_fitting = width / (LETTER * scale);
        let n_letters = text.chars().count();
        let shown: String = if n_letters > n_fitting {
            text.chars().take(n_fitting.saturating_sub(2)).chain("..".chars()).collect()
        } else {
            text.to_owned()
        };
        for (i, letter) in shown.chars().enumerate() {
            let glyph = font8x8::BASIC_FONTS.get(letter).or_else(|| font8x8::LATIN_FONTS.get(letter));
            let glyph = glyph.or_else(|| font8x8::GREEK_FONTS.get(letter)).or(font8x8::BASIC_FONTS.get('?'));
            for (row, bits) in glyph.unwrap_or_default().into_iter().enumerate() {
                for column in (0..LETTER).filter(|column| bits & (1 << column) != 0) {
                    let (left, top) = (x + (i * LETTER + column) * scale, y + row * scale);
                    self.fill(left, top, scale, scale, colour);
                }
            }
        }
    }

    pub(super) fn picture(&mut self, x: usize, y: usize, picture: &Thumbnail) {
        for row in 0..picture.height {
            for column in 0..picture.width {
                let at = (row * picture.width + column) * 3;
                let pixel = [picture.rgb[at], picture.rgb[at + 1], picture.rgb[at + 2]];
                self.set(x + column, y + row, pixel);
            }
        }
    }

    /// Draws a line of one pixel's width, steep parts as wide as they need to be.
    pub(super) fn line(&mut self, from: (f64, f64), to: (f64, f64), colour: [u8; 3]) {
        let steps = (to.0 - from.0).abs().max((to.1 - from.1).abs()).ceil().clamp(1.0, 1e5) as usize;
        for step in 0..=steps {
            let share = step as f64 / steps as f64;
            let at = |a: f64, b: f64| (a + (b - a) * share).round();
            let (x, y) = (at(from.0, to.0), at(from.1, to.1));
            if x >= 0.0 && y >= 0.0 {
                self.set(x as usize, y as usize, colour);
            }
        }
    }
}
