//! Text from peers and files, made safe for terminals, logs and screens.
//!
//! The last step before a text is shown makes it printable: the error of a program, a line of a log, standard output,
//! progress bars and the overlay. Messages before that quote names as they are.

use std::fmt::Display;

/// The most characters of a peer's text that are kept.
const MAX_CHARS: usize = 300;

/// The most characters of a line that are shown: enough for a path and what is wrong with its file.
const LONGEST_LINE: usize = 5000;

/// The text without characters that forge lines, reverse the direction of writing or are invisible; cut to a few lines.
pub fn printable(text: &str) -> String {
    text.chars().filter(|&letter| is_printable(letter)).take(MAX_CHARS).collect()
}

/// The text as one line, with a space for each line end and tab, and without other characters that [`printable`] leaves
/// out. Cut at 5000 characters.
pub fn printable_line(text: &str) -> String {
    let space = |letter: char| if letter.is_control() && letter.is_whitespace() { ' ' } else { letter };
    let mut line: String =
        text.trim_end().chars().map(space).filter(|&letter| is_printable(letter)).take(LONGEST_LINE + 1).collect();
    if let Some((end, _)) = line.char_indices().nth(LONGEST_LINE) {
        line.truncate(end);
        line.push('…');
    }
    line
}

/// The lines of a table or of a file, without control characters.
pub fn printable_lines(text: &str) -> String {
    text.chars().filter(|&letter| letter == '\n' || !letter.is_control()).collect()
}

/// A number with its noun, which is in the singular for one: "1 triangle", "2 triangles", "0 triangles".
pub fn counted(count: impl Display, noun: &str) -> String {
    let count = count.to_string();
    let is_one = count == "1";
    format!("{count} {}", plural(is_one, noun))
}

/// A number with `n_digits` digits; with an exponent where it is very small, or has more digits than that before its point
/// and is a million or more.
pub fn significant(value: f64, n_digits: usize) -> String {
    let magnitude = value.abs();
    let is_long = magnitude >= 1e6 && n_digits < n_whole(value);
    if magnitude != 0.0 && (magnitude < 1e-3 || is_long) {
        return format!("{value:.*e}", n_digits - 1);
    }
    let n_zeros = if magnitude > 0.0 && magnitude < 1.0 { -magnitude.log10().floor() as usize } else { 0 };
    format!("{value:.*}", n_digits.saturating_sub(n_whole(value)) + n_zeros)
}

/// Digits before the decimal point.
pub fn n_whole(value: f64) -> usize {
    if value.abs() >= 1.0 { (value.abs().log10().floor() as usize).saturating_add(1) } else { 1 }
}

/// Bytes with up to three digits and a unit.
pub fn bytes(bytes: u64) -> String {
    let bytes = bytes as f64;
    match bytes {
        ..1e3 => format!("{bytes} B"),
        ..1e4 => format!("{:.1} KB", bytes / 1e3),
        ..1e6 => format!("{:.0} KB", bytes / 1e3),
        ..1e7 => format!("{:.1} MB", bytes / 1e6),
        ..1e9 => format!("{:.0} MB", bytes / 1e6),
        ..1e10 => format!("{:.1} GB", bytes / 1e9),
        _ => format!("{:.0} GB", bytes / 1e9),
    }
}

/// The noun alone: in the singular if `is_one`.
pub fn plural(is_one: bool, noun: &str) -> String {
    match noun.strip_suffix("ex") {
        _ if is_one => noun.to_owned(),
        Some(stem) => format!("{stem}ices"),
        None => format!("{noun}s"),
    }
}

fn is_printable(letter: char) -> bool {
    !letter.is_control() && !is_invisible(letter)
}

/// Direction marks, joiners and other characters of no width.
fn is_invisible(letter: char) -> bool {
    matches!(letter, '\u{ad}' | '\u{61c}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2060}'..='\u{206f}'
        | '\u{feff}' | '\u{e0000}'..='\u{e007f}')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_have_up_to_three_digits() {
        let shown = [0, 999, 1500, 25_400, 6_940_000, 123_400_000, 1_234_000_000, 20_000_000_000].map(bytes);
        assert_eq!(shown, ["0 B", "999 B", "1.5 KB", "25 KB", "6.9 MB", "123 MB", "1.2 GB", "20 GB"]);
    }

    #[test]
    fn lengths_have_five_digits_in_any_unit() {
        let lengths = [0.0, 1.0, -0.123_456, 12.345_67, 99_999.4, 123_456.0, 1.5e-7, 2e9];
        let expected = ["0.0000", "1.0000", "-0.12346", "12.346", "99999", "123456", "1.5000e-7", "2.0000e9"];
        assert_eq!(lengths.map(|length| significant(length, 5)), expected);
    }

    #[test]
    fn what_forges_or_hides_is_left_out() {
        assert_eq!(printable("a\nERROR fake\u{1b}[31m\u{202e}b"), "aERROR fake[31mb");
        assert_eq!(printable("Zürich – 研究室 1"), "Zürich – 研究室 1");
        assert_eq!(printable(&"x".repeat(5000)).len(), 300);
    }

    #[test]
    fn one_of_a_kind_is_in_the_singular() {
        assert_eq!([0_u32, 1, 2].map(|n| counted(n, "triangle")), ["0 triangles", "1 triangle", "2 triangles"]);
        assert_eq!([1, 2].map(|n| counted(n, "vertex")), ["1 vertex", "2 vertices"]);
        assert_eq!(counted("1 000", "triangle"), "1 000 triangles");
    }

    #[test]
    fn a_line_stays_one_line_and_a_table_keeps_its_lines() {
        let text = "element `a\r\nerror: fake\u{1b}[2J\u{9b}1m\u{202e}`:\t1 – Zürich\n";
        assert_eq!(printable_line(text), "element `a  error: fake[2J1m`: 1 – Zürich");
        assert_eq!(printable_lines("one\u{1b}[1A\r\ntwo\u{7}\n"), "one[1A\ntwo\n");
        let cut = printable_line(&"é".repeat(10_000));
        assert!(cut.chars().count() == 5001 && cut.ends_with("é…"));
    }
}
