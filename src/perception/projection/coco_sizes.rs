//! Usual sizes of the 80 kinds of objects of COCO, for labels without a configured size.
//!
//! Sources by group. *Road*: mean sizes of the annotated boxes of KITTI (Geiger et al., CVPR 2012)
//! and nuScenes (Caesar et al., CVPR 2020). *People*: NCD-RisC, "Height and body-mass index
//! trajectories", Lancet 2020, adults with shoes, and children in the spread. *Standards*: lenses
//! of 0.2 and 0.3 m (EN 12368), stop signs of 0.6 to 0.9 m (Vienna Convention, MUTCD), hydrants
//! (AWWA C502), balls, bats and rackets by the rules of their sports. *Estimates*: animals by
//! common breeds at the back or head, furniture and things of a household as sold; the spread
//! covers how they lie and are held.

use super::ObjectSize;

/// The usual size of a kind of COCO.
pub(super) fn of(label: &str) -> Option<&'static ObjectSize> {
    SIZES
        .iter()
        .find(|(name, _)| *name == label)
        .map(|(_, size)| size)
}

const fn size(width_m: f64, length_m: f64, height_m: f64, relative_sigma: f64) -> ObjectSize {
    ObjectSize {
        width_m,
        height_m,
        length_m: Some(length_m),
        relative_sigma,
    }
}

#[rustfmt::skip]
static SIZES: [(&str, ObjectSize); 80] = [
    // People and road.
    ("person", size(0.5, 0.35, 1.67, 0.12)),
    ("bicycle", size(0.6, 1.7, 1.1, 0.15)),
    ("car", size(1.75, 4.2, 1.53, 0.1)),
    ("motorcycle", size(0.8, 2.1, 1.3, 0.2)),
    ("bus", size(2.7, 11.0, 3.3, 0.15)),
    ("truck", size(2.5, 7.5, 2.9, 0.25)),
    ("train", size(3.0, 20.0, 4.0, 0.15)),
    ("airplane", size(30.0, 35.0, 11.0, 0.6)),
    ("boat", size(2.5, 7.0, 2.5, 0.6)),
    // Standards.
    ("traffic light", size(0.35, 0.35, 0.95, 0.25)),
    ("stop sign", size(0.75, 0.0, 0.75, 0.15)),
    ("fire hydrant", size(0.4, 0.4, 0.75, 0.2)),
    ("parking meter", size(0.3, 0.2, 1.3, 0.3)),
    ("frisbee", size(0.27, 0.27, 0.1, 0.6)),
    ("skis", size(0.3, 1.7, 0.8, 0.6)),
    ("snowboard", size(0.3, 1.5, 0.8, 0.6)),
    ("sports ball", size(0.2, 0.2, 0.2, 0.4)),
    ("baseball bat", size(0.2, 0.8, 0.5, 0.5)),
    ("baseball glove", size(0.28, 0.2, 0.28, 0.25)),
    ("skateboard", size(0.2, 0.8, 0.2, 0.5)),
    ("surfboard", size(0.5, 2.0, 1.2, 0.5)),
    ("tennis racket", size(0.27, 0.5, 0.5, 0.4)),
    // Estimates: animals.
    ("bird", size(0.15, 0.3, 0.2, 0.5)),
    ("cat", size(0.18, 0.46, 0.28, 0.25)),
    ("dog", size(0.25, 0.75, 0.55, 0.35)),
    ("horse", size(0.6, 2.3, 1.9, 0.15)),
    ("sheep", size(0.45, 1.2, 0.85, 0.2)),
    ("cow", size(0.7, 2.3, 1.45, 0.15)),
    ("elephant", size(1.8, 5.0, 2.8, 0.25)),
    ("bear", size(0.8, 1.8, 1.1, 0.3)),
    ("zebra", size(0.6, 2.2, 1.6, 0.12)),
    ("giraffe", size(0.9, 2.5, 4.5, 0.15)),
    // Estimates: furniture and street.
    ("bench", size(1.5, 0.6, 0.85, 0.2)),
    ("chair", size(0.5, 0.5, 0.88, 0.15)),
    ("couch", size(1.9, 0.9, 0.85, 0.15)),
    ("bed", size(1.5, 2.0, 0.7, 0.35)),
    ("dining table", size(0.9, 1.5, 0.76, 0.15)),
    ("potted plant", size(0.4, 0.4, 0.6, 0.6)),
    ("toilet", size(0.38, 0.68, 0.75, 0.25)),
    ("tv", size(1.0, 0.1, 0.6, 0.4)),
    ("microwave", size(0.5, 0.38, 0.29, 0.12)),
    ("oven", size(0.6, 0.6, 0.75, 0.25)),
    ("toaster", size(0.3, 0.2, 0.2, 0.2)),
    ("sink", size(0.55, 0.45, 0.2, 0.5)),
    ("refrigerator", size(0.65, 0.65, 1.7, 0.15)),
    // Estimates: things that are carried.
    ("backpack", size(0.32, 0.2, 0.47, 0.2)),
    ("umbrella", size(1.0, 1.0, 0.7, 0.5)),
    ("handbag", size(0.3, 0.14, 0.3, 0.35)),
    ("tie", size(0.09, 0.02, 0.45, 0.3)),
    ("suitcase", size(0.42, 0.26, 0.62, 0.25)),
    ("kite", size(1.0, 1.0, 0.8, 0.6)),
    // Estimates: things of a household.
    ("bottle", size(0.075, 0.075, 0.25, 0.25)),
    ("wine glass", size(0.08, 0.08, 0.2, 0.15)),
    ("cup", size(0.085, 0.085, 0.1, 0.25)),
    ("fork", size(0.03, 0.19, 0.06, 0.6)),
    ("knife", size(0.03, 0.21, 0.06, 0.6)),
    ("spoon", size(0.04, 0.17, 0.06, 0.6)),
    ("bowl", size(0.16, 0.16, 0.07, 0.35)),
    ("banana", size(0.04, 0.18, 0.08, 0.5)),
    ("apple", size(0.075, 0.075, 0.075, 0.12)),
    ("sandwich", size(0.12, 0.12, 0.06, 0.4)),
    ("orange", size(0.075, 0.075, 0.075, 0.12)),
    ("broccoli", size(0.12, 0.12, 0.12, 0.4)),
    ("carrot", size(0.03, 0.17, 0.05, 0.6)),
    ("hot dog", size(0.05, 0.15, 0.05, 0.35)),
    ("pizza", size(0.3, 0.3, 0.06, 0.6)),
    ("donut", size(0.09, 0.09, 0.05, 0.4)),
    ("cake", size(0.22, 0.22, 0.12, 0.4)),
    ("laptop", size(0.34, 0.24, 0.22, 0.3)),
    ("mouse", size(0.06, 0.11, 0.038, 0.3)),
    ("remote", size(0.05, 0.17, 0.05, 0.6)),
    ("keyboard", size(0.44, 0.14, 0.06, 0.5)),
    ("cell phone", size(0.073, 0.01, 0.13, 0.3)),
    ("book", size(0.15, 0.05, 0.2, 0.4)),
    ("clock", size(0.3, 0.05, 0.3, 0.5)),
    ("vase", size(0.15, 0.15, 0.28, 0.35)),
    ("scissors", size(0.08, 0.18, 0.1, 0.5)),
    ("teddy bear", size(0.25, 0.2, 0.35, 0.4)),
    ("hair drier", size(0.09, 0.22, 0.22, 0.2)),
    ("toothbrush", size(0.02, 0.18, 0.08, 0.6)),
];
