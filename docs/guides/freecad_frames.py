"""A macro for FreeCAD 1.0 or later: the assembly of the active document as a table of frames for `rfem-jax import`.

Put it into the folder of macros (Macro, Macros..., User macros location), or paste it into the Python console. It
writes a CSV file beside the document: parts with masses, centres and inertias, joints with kinds, centres and axes.
Solve the assembly before; grounded parts are the base. Set the densities here:
"""

import csv
import os

import FreeCAD
import Part
import UtilsAssembly  # of the workbench Assembly

DENSITY = 7850.0  # kg/m^3, of all parts that are not named in DENSITIES
DENSITIES = {}  # kg/m^3 by labels, as {"Rod": 2700.0}
KINDS = {
    "Fixed": "fixed",
    "Revolute": "revolute",
    "Cylindrical": "cylindrical",
    "Slider": "prismatic",
    "Ball": "spherical",
}
MOMENTS = ("xx", "yy", "zz", "xy", "xz", "yz")


def inertia(shape, density):
    """Mass [kg], centre [mm] and inertia about it [kg mm^2] of all solids of a shape."""
    solids = shape.Solids
    masses = [1e-9 * density * one.Volume for one in solids]
    mass = sum(masses)
    centre = [sum(m * one.CenterOfMass[k] for m, one in zip(masses, solids)) / mass for k in range(3)]
    tensor = [[0.0] * 3 for _ in range(3)]
    for m, one in zip(masses, solids):
        # Principal moments with their axes leave no doubt about the signs of products of inertia.
        found = one.PrincipalProperties
        axes = [found[name + "AxisOfInertia"] for name in ("First", "Second", "Third")]
        away = [one.CenterOfMass[k] - centre[k] for k in range(3)]
        square = sum(x * x for x in away)
        for i in range(3):
            for j in range(3):
                turned = sum(moment * axis[i] * axis[j] for moment, axis in zip(found["Moments"], axes))
                tensor[i][j] += 1e-9 * density * turned + m * ((i == j) * square - away[i] * away[j])
    return mass, centre, {"xx": tensor[0][0], "yy": tensor[1][1], "zz": tensor[2][2],
                          "xy": tensor[0][1], "xz": tensor[0][2], "yz": tensor[1][2]}  # fmt: skip


def sides(assembly, joint, grounded):
    """Of parent and child of a joint: label, object, and its frame there in global axes."""
    found = []
    for number in "12":
        reference, place = getattr(joint, "Reference" + number), getattr(joint, "Placement" + number)
        frame = UtilsAssembly.getJcsGlobalPlc(place, reference)
        names = [reference[0].Name] + reference[1][0].split(".")
        if assembly.Name in names:
            names = names[names.index(assembly.Name) + 1 :]
        else:  # later versions begin at the part
            frame = assembly.Placement.multiply(frame)
        parts = [assembly.Document.getObject(name) for name in names]
        part = next((one for one in parts if one and one.TypeId != "App::DocumentObjectGroup"), None)
        still = part is None or part.Name in grounded or part.TypeId == "App::Origin"
        found.append(("base" if still else part.Label, part, frame))
    return found


def main():
    """Write the table, and say what is not in it."""
    document = FreeCAD.ActiveDocument
    assembly = next(one for one in document.Objects if one.TypeId == "Assembly::AssemblyObject")
    grounded = {one.ObjectToGround.Name for one in document.Objects if getattr(one, "ObjectToGround", None)}
    rows, parts = [], {}
    for joint in [one for one in document.Objects if hasattr(one, "JointType")]:
        if not getattr(joint, "Activated", True) or getattr(joint, "Suppressed", False) or joint.JointType not in KINDS:
            print("Not in the table: the joint " + joint.Label + " (" + joint.JointType + ")")
            continue
        (parent, one, left), (child, other, right) = sides(assembly, joint, grounded)
        parts.update({end: part for end, part in ((parent, one), (child, other)) if end != "base"})
        axis, centre = left.Rotation.multVec(FreeCAD.Vector(0, 0, 1)), left.Base
        row = {"name": joint.Label, "kind": KINDS[joint.JointType], "parent": parent, "child": child}
        for k, letter in enumerate("xyz"):
            row[letter + "_mm"], row["axis_" + letter] = centre[k], axis[k]
            if joint.JointType == "Slider":
                row["child_" + letter + "_mm"] = right.Base[k]
        rows.append(row)
    for label, part in parts.items():
        shape = Part.getShape(part).copy()
        shape.Placement = assembly.Placement.multiply(shape.Placement)
        mass, centre, tensor = inertia(shape, DENSITIES.get(label, DENSITY))
        row = {"name": label, "kind": "body", "mass_kg": mass}
        row.update({"centre_" + letter + "_mm": centre[k] for k, letter in enumerate("xyz")})
        row.update({key + "_kgmm2": tensor[key] for key in MOMENTS})
        rows.append(row)
    columns = ["name", "kind", "parent", "child", "x_mm", "y_mm", "z_mm", "axis_x", "axis_y", "axis_z"]
    columns += ["child_x_mm", "child_y_mm", "child_z_mm", "mass_kg", "centre_x_mm", "centre_y_mm", "centre_z_mm"]
    columns += [key + "_kgmm2" for key in MOMENTS]
    path = os.path.splitext(document.FileName)[0] + "_frames.csv"
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="")
        writer.writeheader()
        writer.writerows(rows)
    print(path + " written")


main()
