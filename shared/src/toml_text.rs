//! Faults of TOML files in plain words.

/// The words of the parser, or plainer ones for what people write; on one line. `offset` is the byte at fault.
pub fn plain_problem(text: &str, offset: usize, message: &str) -> String {
    let start = text.get(..offset).and_then(|before| before.rfind('\n')).map_or(0, |end| end + 1);
    let line = text.get(start..).and_then(|rest| rest.lines().next()).unwrap_or_default();
    match lone_point(line).filter(|_| message.contains("digit")) {
        Some(number) => format!("a number needs a digit before and after its point, unlike {number}"),
        None => message.trim().replace('\n', ", "),
    }
}

/// The first number of a line that has a digit only before its point, or only after it.
fn lone_point(line: &str) -> Option<&str> {
    let is_of_number = |letter: char| letter.is_ascii_digit() || matches!(letter, '.' | '-' | '+' | 'e' | 'E' | '_');
    line.split(|letter| !is_of_number(letter)).find(|word| {
        word.split_once('.').is_some_and(|(whole, part)| {
            let [has_whole, has_part] =
                [whole.ends_with(|it: char| it.is_ascii_digit()), part.starts_with(|it: char| it.is_ascii_digit())];
            has_whole != has_part
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_that_begins_or_ends_with_its_point_is_shown() {
        for number in [".9", "-.5", "9.", "2.e3"] {
            let text = format!("a = [1.5, 2]\nb = [0, {number}]\n");
            let error = toml::from_str::<toml::Table>(&text).unwrap_err();
            let plain = plain_problem(&text, error.span().unwrap().start, error.message());
            let expected = format!("a number needs a digit before and after its point, unlike {number}");
            assert_eq!(plain, expected, "{error}");
        }
        let error = toml::from_str::<toml::Table>("a = [0.5, 1.5").unwrap_err();
        assert_eq!(plain_problem("a = [0.5, 1.5", error.span().unwrap().start, error.message()), error.message());
        assert_eq!(plain_problem("a", 7, "no digits\nhere"), "no digits, here", "an offset beyond the text");
    }
}
