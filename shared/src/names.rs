//! Names of an enum's variants, on command lines and on screen; `strum` derives them.

use std::fmt::Display;

use strum::VariantArray;

/// The error for a text that names no variant of `E`; it lists the names that exist.
pub fn unknown_name<E: VariantArray + Display>(text: &str) -> String {
    let names: Vec<_> = E::VARIANTS.iter().map(ToString::to_string).collect();
    format!("\"{text}\" is not one of: {}", names.join(", "))
}

#[cfg(test)]
mod tests {
    use crate::division::Division;

    #[test]
    fn an_unknown_name_is_told_what_there_is() {
        let error = "round".parse::<Division>().unwrap_err();
        assert_eq!(error, "\"round\" is not one of: interleaved, tiled, dynamic");
    }
}
