//! Types stay small: a type with many fields or many methods is split, or says why not.

use std::collections::BTreeMap;
use std::fs;

use crate::layers::{roots, rust_files};

const MAX_FIELDS: usize = 12;
const MAX_METHODS: usize = 30;
/// What the reason begins with, in the doc comment of the type.
const MANY_FIELDS: &str = "Many fields:";
const MANY_METHODS: &str = "Many methods:";

/// A type as its source declares it.
#[derive(Debug, Default)]
struct Type {
    path: String,
    docs: String,
    n_fields: usize,
    n_methods: usize,
}

/// The name behind a keyword such as `struct`, without generics.
fn name_behind<'a>(line: &'a str, keyword: &str) -> Option<&'a str> {
    let line = line
        .strip_prefix("pub(crate) ")
        .or_else(|| line.strip_prefix("pub(super) "))
        .or_else(|| line.strip_prefix("pub "))
        .unwrap_or(line);
    let rest = line.strip_prefix(keyword)?.strip_prefix(' ')?;
    let end = rest.find(|c: char| !(c.is_alphanumeric() || c == '_'));
    Some(&rest[..end.unwrap_or(rest.len())])
}

/// The type of an `impl Type {` or `impl<T> Type<T> {`; `None` for the impl of a trait.
fn implemented(line: &str) -> Option<&str> {
    let rest = line.strip_prefix("impl")?;
    if line.contains(" for ") {
        return None;
    }
    let rest = match rest.strip_prefix('<') {
        Some(generic) => &generic[generic.find('>')? + 1..],
        None => rest,
    };
    name_behind(&format!("struct{rest}"), "struct")
        .and_then(|name| line.find(name).map(|at| &line[at..at + name.len()]))
}

/// Whether a line inside a struct at the top of a file declares a field.
fn is_field(line: &str) -> bool {
    let Some(line) = line.strip_prefix("    ") else {
        return false;
    };
    let is_start = line.starts_with(|c: char| c.is_lowercase() || c == '_');
    let line = line.strip_prefix("pub(crate) ").unwrap_or(line);
    let line = line.strip_prefix("pub(super) ").unwrap_or(line);
    let line = line.strip_prefix("pub ").unwrap_or(line);
    let name = line.split(':').next().unwrap_or_default();
    is_start
        && line.contains(':')
        && name
            .chars()
            .all(|c| c.is_lowercase() || c.is_ascii_digit() || c == '_')
}

fn is_method(line: &str) -> bool {
    let Some(line) = line
        .strip_prefix("    ")
        .filter(|line| !line.starts_with(' '))
    else {
        return false;
    };
    let line = line.strip_prefix("pub(crate) ").unwrap_or(line);
    let line = line.strip_prefix("pub(super) ").unwrap_or(line);
    let head = line.split('(').next().unwrap_or_default();
    !line.starts_with("//") && head.split(' ').any(|word| word == "fn")
}

/// What `text` declares, added to `types` of its crate. `rustfmt` puts every item's end at its own indentation.
fn count(text: &str, path: &str, types: &mut BTreeMap<String, Type>) {
    let mut docs = String::new();
    let mut inside: Option<(String, bool)> = None;
    let mut n_fields = 0;
    for line in text.lines() {
        if line == "mod tests {" {
            return;
        }
        if let Some((name, is_struct)) = &inside {
            let found = types.entry(name.clone()).or_default();
            if line.starts_with('}') {
                inside = None;
            } else if *is_struct {
                n_fields += usize::from(is_field(line));
                // Two modules may have a type of one name.
                found.n_fields = found.n_fields.max(n_fields);
            } else {
                found.n_methods += usize::from(is_method(line));
            }
            continue;
        }
        if let Some(doc) = line.strip_prefix("///") {
            docs.push_str(doc);
            continue;
        }
        if let Some(name) = name_behind(line, "struct") {
            let found = types.entry(name.to_owned()).or_default();
            found.docs.push_str(&docs);
            path.clone_into(&mut found.path);
            inside = line.ends_with('{').then(|| (name.to_owned(), true));
            n_fields = 0;
        } else if let Some(name) = implemented(line).filter(|_| line.ends_with('{')) {
            inside = Some((name.to_owned(), false));
        }
        if !line.starts_with('#') && !line.starts_with("    ") {
            docs.clear();
        }
    }
}

/// Parameters and messages have as many fields as there are keys, whatever we would like.
fn is_schema(name: &str, path: &str) -> bool {
    name.ends_with("Params") || name.ends_with("Keys") || path.starts_with("crates/splat-msgs/")
}

#[test]
fn a_type_with_many_fields_or_methods_says_why() {
    let mut faults = Vec::new();
    let mut n_types = 0;
    for (_, root) in roots() {
        let mut types = BTreeMap::new();
        for path in rust_files(&root) {
            if !path.ends_with("tests.rs") {
                let text = fs::read_to_string(&path).unwrap();
                count(&text, path.to_str().unwrap(), &mut types);
            }
        }
        n_types += types.len();
        for (name, found) in types {
            let Type {
                n_fields,
                n_methods,
                docs,
                path,
            } = found;
            if n_fields > MAX_FIELDS && !docs.contains(MANY_FIELDS) && !is_schema(&name, &path) {
                faults.push(format!("{path}: {name} has {n_fields} fields"));
            }
            if n_methods > MAX_METHODS && !docs.contains(MANY_METHODS) {
                faults.push(format!("{path}: {name} has {n_methods} methods"));
            }
        }
    }
    assert!(n_types > 500, "{n_types} types were found");
    assert!(faults.is_empty(), "split, or say why: {faults:#?}");
}

#[test]
fn fields_and_methods_are_counted() {
    let mut types = BTreeMap::new();
    let text = "/// Doc. Many fields: of a test.\n#[derive(Debug)]\npub struct A<T> {\n    /// One: not two.\n    pub a: u8,\n    \
        b: Vec<T>,\n    pub(crate) c: u8,\n}\n\nimpl<T> A<T> {\n    /// fn no\n    pub fn x(&self) {\n        let y: u8 = 3;\n    }\n\n    \
        pub(crate) const fn z() {}\n}\n\nimpl Clone for A<u8> {\n    fn clone(&self) -> Self {\n    }\n}\n";
    count(text, "a.rs", &mut types);
    let a = &types["A"];
    assert_eq!((a.n_fields, a.n_methods), (3, 2));
    assert!(a.docs.contains(MANY_FIELDS));
}
