//! Text from peers, made safe for logs and screens.

/// The most characters of a peer's text that are kept.
const MAX_CHARS: usize = 300;

/// The text without characters that forge lines, reverse the direction of writing or are invisible; cut to a few lines.
pub fn printable(text: &str) -> String {
    text.chars().filter(|&letter| !letter.is_control() && !is_invisible(letter)).take(MAX_CHARS).collect()
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
    fn what_forges_or_hides_is_left_out() {
        assert_eq!(printable("a\nERROR fake\u{1b}[31m\u{202e}b"), "aERROR fake[31mb");
        assert_eq!(printable("Zürich – 研究室 1"), "Zürich – 研究室 1");
        assert_eq!(printable(&"x".repeat(5000)).len(), 300);
    }
}
