//! Heads of Radiance HDR images, as any program writes them, and all eight orders of rows and columns.
//!
//! Ward, "Real Pixels" (Graphics Gems II, 1991), and Radiance's "File Formats". The decoder of the crate `image` wants a head of
//! its own kind: it gets one, and the texels are put in order afterwards.

use std::io::{BufRead, Cursor, Read};

use image::{ImageDecoder, codecs::hdr::HdrDecoder};

use super::{check_size, damaged};

/// Longer heads are none.
const MOST_HEAD: u64 = 1 << 16;

/// What a head says.
#[derive(Debug)]
struct Head {
    /// The numbers in the file over the light that they stand for.
    exposure: [f32; 3],
    order: Order,
}

/// The order of texels: lines, and texels along each.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Order {
    n_lines: u32,
    n_along: u32,
    lines_are_columns: bool,
    /// Whether x grows to the right, and y down.
    x_grows: bool,
    y_falls: bool,
}

/// Width, height, and linear light row by row from the top.
pub(super) fn decode(mut file: impl BufRead) -> Result<(u32, u32, Vec<[f32; 3]>), String> {
    let Head { exposure, order } = Head::read(&mut file)?;
    let [width, height] = order.size();
    check_size(width, height)?;
    let head = format!("#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {} +X {}\n", order.n_lines, order.n_along);
    let decoder = HdrDecoder::new(Cursor::new(head).chain(file)).map_err(|error| damaged(&error))?;
    let mut stored = vec![[0.0f32; 3]; width as usize * height as usize];
    decoder.read_image(bytemuck::cast_slice_mut(&mut stored)).map_err(|error| damaged(&error))?;
    let texel = |index: usize| {
        let [x, y] = [index as u32 % width, index as u32 / width];
        let texel = stored[order.place(x, y)];
        [0, 1, 2].map(|channel| texel[channel] / exposure[channel])
    };
    Ok((width, height, (0..stored.len()).map(texel).collect()))
}

impl Head {
    fn read(file: &mut impl BufRead) -> Result<Self, String> {
        let mut head = file.take(MOST_HEAD);
        let mut line = || {
            let mut line = Vec::new();
            head.read_until(b'\n', &mut line).map_err(|error| format!("cannot be read: {error}"))?;
            let is_whole = line.pop() == Some(b'\n');
            let line = String::from_utf8_lossy(&line).trim().to_owned();
            if is_whole { Ok(line) } else { Err("ends within its head: copy it again, or convert it".to_owned()) }
        };
        let mut exposure = [1.0f32; 3];
        loop {
            let variable = line()?;
            let (name, value) = variable.split_once('=').unwrap_or((&variable, ""));
            let mut factors = value.split_whitespace().map(|number| number.parse::<f32>().ok());
            match name.trim() {
                "" => break,
                "FORMAT" if value.trim() != "32-bit_rle_rgbe" => {
                    return Err(format!("has the format {:?}: convert it to 32-bit_rle_rgbe", value.trim()));
                }
                "EXPOSURE" => {
                    let factor = factors.next().flatten();
                    exposure = exposure.map(|all| all * factor.unwrap_or(1.0));
                }
                "COLORCORR" => exposure.iter_mut().zip(factors).for_each(|(all, factor)| *all *= factor.unwrap_or(1.0)),
                _ => {}
            }
        }
        // A factor of another kind says nothing about the light.
        let exposure = exposure.map(|all| if all.is_normal() && all > 0.0 { all } else { 1.0 });
        let size = line()?;
        let order = Order::parse(&size);
        let order =
            order.ok_or_else(|| format!("has the size {size:?}, which should be as -Y 1024 +X 2048: convert it"))?;
        Ok(Self { exposure, order })
    }
}

impl Order {
    /// Parses two axes with their lengths, as `-Y 1024 +X 2048`.
    fn parse(text: &str) -> Option<Self> {
        let words: Vec<_> = text.split_whitespace().collect();
        let &[first, n_lines, second, n_along] = words.as_slice() else { return None };
        let is_positive = |axis: &str, name: char| match axis.strip_suffix(name)? {
            "+" => Some(true),
            "-" => Some(false),
            _ => None,
        };
        let lines_are_columns = first.ends_with('X');
        let (x, y) = if lines_are_columns { (first, second) } else { (second, first) };
        let (x_grows, y_falls) = (is_positive(x, 'X')?, !is_positive(y, 'Y')?);
        Some(Self {
            n_lines: n_lines.parse().ok()?,
            n_along: n_along.parse().ok()?,
            lines_are_columns,
            x_grows,
            y_falls,
        })
    }

    /// Width and height.
    fn size(self) -> [u32; 2] {
        if self.lines_are_columns { [self.n_lines, self.n_along] } else { [self.n_along, self.n_lines] }
    }

    /// The place in the file of the texel at (x, y) from the upper left.
    fn place(self, x: u32, y: u32) -> usize {
        let [width, height] = self.size();
        let x = if self.x_grows { x } else { width - 1 - x };
        let y = if self.y_falls { y } else { height - 1 - y };
        let (line, along) = if self.lines_are_columns { (x, y) } else { (y, x) };
        line as usize * self.n_along as usize + along as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An image of 4×2 texels without compression: x + 4 y from the upper left is the red one's number.
    fn file(head: &[u8], size: &str, place: impl Fn(u32, u32) -> usize) -> Vec<u8> {
        let mut texels = [[0; 4]; 8];
        for (x, y) in (0..2).flat_map(|y| (0..4).map(move |x| (x, y))) {
            // An exponent of 128 + 8 makes light of the numbers themselves.
            texels[place(x, y)] = [(x + 4 * y) as u8, 8, 16, 136];
        }
        [head, b"\n", size.as_bytes(), b"\n", texels.as_flattened()].concat()
    }

    #[test]
    fn every_order_of_texels_is_read() {
        let order = |x: bool, y: bool, columns: bool| {
            let (x, y) = (if x { "+X 4" } else { "-X 4" }, if y { "-Y 2" } else { "+Y 2" });
            if columns { format!("{x} {y}") } else { format!("{y} {x}") }
        };
        for case in 0..8 {
            let [right, down, columns] = [1, 2, 4].map(|bit| case & bit != 0);
            let place = |x: u32, y: u32| {
                let (x, y) = (if right { x } else { 3 - x }, if down { y } else { 1 - y });
                (if columns { 2 * x + y } else { 4 * y + x }) as usize
            };
            let size = order(right, down, columns);
            let (width, height, texels) = decode(&*file(b"#?RGBE\r\n# made by hand\n", &size, place)).unwrap();
            assert_eq!((width, height), (4, 2), "{size}");
            let red: Vec<_> = texels.iter().map(|texel| texel[0]).collect();
            assert_eq!(red, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0], "{size}");
        }
    }

    #[test]
    fn the_light_is_that_before_the_exposure() {
        let head = b"#?RADIANCE\nEXPOSURE= 2.0\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\nCOLORCORR=1 2 4\nVIEW=\xff\n";
        let (.., texels) = decode(&*file(head, "-Y 2 +X 4", |x, y| (4 * y + x) as usize)).unwrap();
        assert_eq!(texels[4], [1.0, 1.0, 1.0]);
        for factor in ["0", "NaN", "-1", "1e-40", "x", ""] {
            let head = format!("#?RADIANCE\nEXPOSURE={factor}\n");
            let (.., texels) = decode(&*file(head.as_bytes(), "-Y 2 +X 4", |x, y| (4 * y + x) as usize)).unwrap();
            assert_eq!(texels[4], [4.0, 8.0, 16.0], "{factor}");
        }
    }

    #[test]
    fn heads_that_are_none_are_refused_in_a_line() {
        let told = |bytes: &[u8]| decode(bytes).unwrap_err();
        assert!(told(b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 2 +X 4\n").contains("convert it to 32-bit_rle_rgbe"));
        for size in ["", "-Y 2", "-Y 2 +Y 4", "-Y 2 X 4", "-Y two +X 4", "-Y 99999999999 +X 4", "-Y -2 +X 4"] {
            let line = told(format!("#?RADIANCE\n\n{size}\n").as_bytes());
            assert!(line.contains("-Y 1024 +X 2048"), "{size}: {line}");
        }
        assert!(told(b"#?RADIANCE\nFORMAT=").contains("ends within its head"));
        assert!(told(&[b"#?".as_slice(), &[b'x'; 1 << 17]].concat()).contains("ends within its head"));
        assert!(told(b"#?RADIANCE\n\n-Y 4 +X 2\n").contains("is 2x4"));
    }
}
