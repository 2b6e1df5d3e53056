//! Classes of road users, and their labels here.

use c_its_parser::standards::cdd_2_2_1::etsi_its_cdd::{
    ObjectClass, OtherSubClass, TrafficParticipantType, VruProfileAndSubprofile,
    VruSubProfileAnimal, VruSubProfileBicyclist as LightVehicle, VruSubProfileMotorcyclist,
    VruSubProfilePedestrian,
};

/// Vehicles by `TrafficParticipantType`; the first label of a type is used for received messages.
const VEHICLES: [(&str, u8); 12] = [
    ("vehicle", 0),
    ("car", 5),
    ("bus", 6),
    ("van", 7),
    ("pickup", 7),
    ("truck", 8),
    ("trailer", 9),
    ("special vehicle", 10),
    ("tram", 11),
    ("train", 11),
    ("tractor", 14),
    ("agricultural vehicle", 14),
];

/// The class of a label; `None` for labels of no road user.
pub(super) fn road_user(label: &str) -> Option<ObjectClass> {
    use VruProfileAndSubprofile::{animal, bicyclistAndLightVruVehicle, motorcyclist, pedestrian};
    let vru = match label {
        "person" | "pedestrian" => pedestrian(VruSubProfilePedestrian(0)),
        "bicycle" | "cyclist" => bicyclistAndLightVruVehicle(LightVehicle(1)),
        "moped" => motorcyclist(VruSubProfileMotorcyclist(1)),
        "motorcycle" | "motorbike" => motorcyclist(VruSubProfileMotorcyclist(2)),
        "animal" | "dog" | "cat" | "horse" | "sheep" | "cow" => animal(VruSubProfileAnimal(0)),
        _ => {
            let (_, kind) = VEHICLES.iter().find(|(name, _)| *name == label)?;
            return Some(ObjectClass::vehicleSubClass(TrafficParticipantType(*kind)));
        }
    };
    Some(ObjectClass::vruSubClass(vru))
}

/// The class of a label; a single object for labels of no road user.
pub(super) fn of_label(label: &str) -> ObjectClass {
    road_user(label).unwrap_or(ObjectClass::otherSubClass(OtherSubClass(1)))
}

/// The label of a class.
pub(super) fn label(class: &ObjectClass) -> &'static str {
    match class {
        ObjectClass::vehicleSubClass(TrafficParticipantType(kind)) => match kind {
            1 => "person",
            2 | 12 => "bicycle",
            3 => "moped",
            4 => "motorcycle",
            13 => "animal",
            _ => VEHICLES
                .iter()
                .find(|(_, number)| number == kind)
                .map_or("vehicle", |(name, _)| name),
        },
        ObjectClass::vruSubClass(VruProfileAndSubprofile::pedestrian(_)) => "person",
        ObjectClass::vruSubClass(VruProfileAndSubprofile::bicyclistAndLightVruVehicle(
            LightVehicle(profile),
        )) => {
            match profile {
                // Wheelchair user, roller skater, e-scooter, personal transporter: detectors see
                // the person.
                2 | 4..=6 => "person",
                // Horse and rider.
                3 => "animal",
                _ => "bicycle",
            }
        }
        ObjectClass::vruSubClass(VruProfileAndSubprofile::motorcyclist(
            VruSubProfileMotorcyclist(1),
        )) => "moped",
        ObjectClass::vruSubClass(VruProfileAndSubprofile::motorcyclist(_)) => "motorcycle",
        ObjectClass::vruSubClass(VruProfileAndSubprofile::animal(_)) => "animal",
        ObjectClass::groupSubClass(_) => "group",
        _ => "object",
    }
}
