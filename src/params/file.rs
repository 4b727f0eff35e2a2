//! The text of a parameter file -> its values by dotted key. Knows nothing of ranges.

use std::collections::BTreeMap;

use serde_json::Value;

/// YAML text -> the tree under `splat_mapper/ros__parameters` (or under `/**`, as ROS 2 allows).
pub(crate) fn parse_file(text: &str) -> Result<Value, String> {
    let root: Value = serde_saphyr::from_str(text).map_err(|e| e.to_string())?;
    let node = root.get("splat_mapper").or_else(|| root.get("/**"));
    let node = node.ok_or("no top-level key splat_mapper")?;
    let tree = node
        .get("ros__parameters")
        .ok_or("no key ros__parameters under the node's name")?;
    if tree.is_object() {
        Ok(tree.clone())
    } else {
        Err("ros__parameters holds no keys".to_owned())
    }
}

/// Leaves of a tree by dotted key.
pub(crate) fn flatten(prefix: &str, tree: &Value, out: &mut BTreeMap<String, Value>) {
    match tree {
        Value::Object(entries) => {
            for (name, value) in entries {
                let key = if prefix.is_empty() {
                    name.clone()
                } else {
                    format!("{prefix}.{name}")
                };
                flatten(&key, value, out);
            }
        }
        leaf => {
            out.insert(prefix.to_owned(), leaf.clone());
        }
    }
}
