//! The town at one moment as GeoJSON (RFC 7946): cells and objects as points, tiles as polygons.

use ecod::model::time::Timestamp;
use serde::Serialize;
use serde_json::{Map, Value, json};

use crate::town::{GeographicBounds, RegionTown, TownView};

/// A collection of features, the document that GeoJSON viewers read.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FeatureCollection {
    r#type: &'static str,
    /// The features, each with `kind` in its properties.
    pub features: Vec<Value>,
}

/// The cells within bounds and all their objects. Each feature has `kind`: `cell`, `tile` or
/// `object`.
pub fn geojson(town: &RegionTown, bounds: &GeographicBounds, now: Timestamp) -> FeatureCollection {
    let TownView {
        cells,
        tiles,
        objects,
        ..
    } = town.view_whole(bounds, now);
    let mut features = Vec::new();
    for tile in tiles {
        let GeographicBounds {
            west,
            south,
            east,
            north,
        } = tile.bounds;
        let ring = json!([[
            [west, south],
            [east, south],
            [east, north],
            [west, north],
            [west, south]
        ]]);
        let properties =
            json!({ "key": tile.key, "cells": tile.totals.cells, "objects": tile.totals.objects });
        features.push(feature("tile", "Polygon", &ring, properties));
    }
    for cell in cells {
        let at = json!([cell.longitude_deg, cell.latitude_deg]);
        features.push(feature("cell", "Point", &at, json!(cell)));
    }
    for object in objects {
        let at = json!([object.longitude_deg, object.latitude_deg]);
        features.push(feature("object", "Point", &at, json!(object)));
    }
    FeatureCollection {
        r#type: "FeatureCollection",
        features,
    }
}

fn feature(kind: &str, geometry: &str, coordinates: &Value, properties: Value) -> Value {
    let mut members = Map::from_iter([("kind".to_owned(), json!(kind))]);
    if let Value::Object(properties) = properties {
        // The geometry has them.
        members.extend(
            properties
                .into_iter()
                .filter(|(name, _)| !["latitude_deg", "longitude_deg"].contains(&&**name)),
        );
    }
    json!({
        "type": "Feature",
        "geometry": { "type": geometry, "coordinates": coordinates },
        "properties": members,
    })
}
