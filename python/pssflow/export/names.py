"""Names of Mitsuba's plugins by class, for messages about those that have no converter.

Users know a plugin by the name that they write in a scene; an object only knows its class.
"""

from __future__ import annotations

PLUGIN_NAMES = {
    # BSDFs
    "BumpMap": "bumpmap",
    "CircularPolarizer": "circular",
    "Hair": "hair",
    "LinearPolarizer": "polarizer",
    "LinearRetarder": "retarder",
    "MaskBSDF": "mask",
    "Measured": "measured",
    "MeasuredPolarized": "measured_polarized",
    "NormalMap": "normalmap",
    "Null": "null",
    "PolarizedPlastic": "pplastic",
    "Principled": "principled",
    "PrincipledThin": "principledthin",
    "RoughDielectric": "roughdielectric",
    "SmoothConductor": "conductor",
    "SmoothDielectric": "dielectric",
    "SmoothPlastic": "plastic",
    "ThinDielectric": "thindielectric",
    # Textures and spectra
    "BlackBodySpectrum": "blackbody",
    "Checkerboard": "checkerboard",
    "IrregularSpectrum": "irregular",
    "MeshAttribute": "mesh_attribute",
    "RegularSpectrum": "regular",
    "VolumeAdapter": "volume",
    # Emitters
    "DirectionalArea": "directionalarea",
    "DirectionalEmitter": "directional",
    "EnvironmentMapEmitter": "envmap",
    "Projector": "projector",
    "SpotLight": "spot",
    "SunskyEmitter": "sunsky",
    "TimedSunskyEmitter": "timed_sunsky",
    # Shapes
    "BSplineCurve": "bsplinecurve",
    "Ellipsoids": "ellipsoids",
    "EllipsoidsMesh": "ellipsoidsmesh",
    "Instance": "instance",
    "LinearCurve": "linearcurve",
    "SDFGrid": "sdfgrid",
    "ShapeGroupPlugin": "shapegroup",
    # Media
    "HeterogeneousMedium": "heterogeneous",
    "HomogeneousMedium": "homogeneous",
    # Sensors and films
    "BatchSensor": "batch",
    "DistantSensor": "distant",
    "DistantSensorImpl": "distant",
    "IrradianceMeter": "irradiancemeter",
    "OrthographicCamera": "orthographic",
    "RadianceMeter": "radiancemeter",
    "SpecFilm": "specfilm",
    "ThinLensCamera": "thinlens",
}
