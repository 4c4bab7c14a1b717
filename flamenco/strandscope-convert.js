// SPDX-License-Identifier: GPL-3.0-or-later
// A job type of Flamenco (docs/flamenco.md): reconstructs the hair of captures and makes a Blender file of each.

const JOB_TYPE = {
    label: "Strandscope: captures to Blender files",
    description: "Find the hairs in each capture and write them as curves, then make a Blender file of them",
    settings: [
        { key: "captures_folder", type: "string", subtype: "dir_path", required: true,
          description: "Folder with the captures in it, each a folder with a capture.json; on storage that all workers see" },
        { key: "captures", type: "string", required: true,
          eval: "'; '.join(p.parent.name for p in sorted(Path(abspath(settings.captures_folder)).glob('*/capture.json')))",
          evalInfo: { showLinkButton: true, description: "All captures in the folder" },
          description: "Folders of captures in it, with semicolons between them" },
        { key: "output_folder", type: "string", subtype: "dir_path", required: true,
          description: "Folder for NAME.npz and NAME.blend of each capture NAME; on storage that all workers see" },
        { key: "preset", type: "string", choices: ["auto", "straight", "wavy", "curls"], default: "auto",
          description: "The paper's settings for a kind of hair; auto estimates them from the photographs" },
        { key: "params", type: "string", subtype: "file_path", default: "",
          description: "A TOML file with settings, in place of the preset" },
        { key: "infill", type: "int32", default: -1, propargs: { min: -1 },
          description: "Number of hairs to add inside, where no camera sees; 0 for none, -1 for as many as are missing" },
        { key: "cores", type: "int32", default: 0, propargs: { min: 0 },
          description: "Processor cores that one task uses; 0 for all that its worker has" },
        { key: "memory", type: "string", default: "6GB",
          description: "Memory that one task uses at most; a capture that needs more is refused" },
        { key: "program", type: "string", choices: ["{strandscope}", "{blender}"], default: "{strandscope}", visible: "submission",
          description: "Variable of the program to run: Strandscope itself, or a Blender with its extension" },
        { key: "task_type", type: "string", default: "misc", visible: "submission",
          description: "Type of the tasks that reconstruct, for which workers are chosen; they need processor cores, and no Blender" },
    ],
};

function compileJob(job) {
    const settings = job.settings;
    const from = place(settings, "captures_folder");
    const to = place(settings, "output_folder");
    const options = reconstructOptions(settings);
    for (const name of captureNames(settings)) {
        const capture = inside(from, name);
        const strands = inside(to, name + ".npz");

        const reconstruct = author.Task("reconstruct " + name, text(settings, "task_type", "misc"));
        reconstruct.addCommand(strandscope(settings, ["reconstruct", capture, "-o", strands].concat(options)));
        job.addTask(reconstruct);

        const blend = author.Task("blend " + name, "blender");
        blend.addDependency(reconstruct);
        blend.addCommand(strandscope(settings, ["blend", strands, inside(to, name + ".blend"), "--capture", capture]));
        job.addTask(blend);
    }
}

function reconstructOptions(settings) {
    const memory = text(settings, "memory", "6GB");
    if (!/^\d+(\.\d+)?\s*[kMGT]?i?B?$/i.test(memory)) {
        wrong("memory", memory, "a number and a unit, as in 6GB");
    }
    const options = ["--memory", memory];
    if (text(settings, "params", "")) {
        options.push("--params", place(settings, "params"));
    } else {
        options.push("--preset", oneOf(settings, "preset", ["auto", "straight", "wavy", "curls"]));
    }
    const infill = whole(settings, "infill", -1, -1);
    if (infill === 0) {
        options.push("--no-infill");
    } else if (infill > 0) {
        options.push("--infill", String(infill));
    }
    const cores = whole(settings, "cores", 0, 0);
    if (cores > 0) {
        options.push("--workers", String(cores));
    }
    return options;
}

// The names in the list, in its order.
function captureNames(settings) {
    const list = text(settings, "captures", "");
    const expected = "folders inside captures_folder, each once, with semicolons between them";
    const names = [];
    for (const part of list.split(";")) {
        const name = part.trim().replace(/\\/g, "/").replace(/\/+$/, "");
        if (!name) {
            continue;
        }
        if (/^\/|^[A-Za-z]:|^\{/.test(name) || name.split("/").indexOf("..") >= 0 || names.indexOf(name) >= 0) {
            wrong("captures", name, expected);
        }
        names.push(name);
    }
    if (names.length === 0) {
        wrong("captures", list, expected);
    }
    return names;
}

// ---- the same in both job types, for Flamenco loads each file alone --------------------------------------------------

// A command that runs a verb of Strandscope.
function strandscope(settings, args) {
    const program = oneOf(settings, "program", ["{strandscope}", "{blender}"]);
    const before = program === "{blender}" ? ["--command", "strandscope"] : [];
    return author.Command("exec", { exe: program, args: before.concat(args) });
}

// An absolute path. One that begins with // would be relative to the Blender file that the job is sent from.
function place(settings, key) {
    const value = text(settings, key, "");
    if (!/^([A-Za-z]:[\\/]|\/(?!\/)|\\\\|\{)/.test(value)) {
        wrong(key, value, "an absolute path that all workers see");
    }
    return value;
}

// A path in a folder. Not path.join, which takes a slash away from \\server.
function inside(folder, name) {
    return folder.replace(/[\\/]+$/, "") + "/" + name;
}

function text(settings, key, without) {
    const value = settings[key];
    return value === undefined || value === null ? without : String(value).trim();
}

function whole(settings, key, without, least) {
    const given = settings[key];
    const value = given === undefined || given === null ? without : Number(given);
    if (Math.floor(value) !== value || value < least) {
        wrong(key, given, "a whole number of at least " + least);
    }
    return value;
}

function oneOf(settings, key, choices) {
    const value = text(settings, key, choices[0]);
    if (choices.indexOf(value) < 0) {
        wrong(key, value, "one of " + choices.join(", "));
    }
    return value;
}

function wrong(key, value, expected) {
    throw new Error("setting " + key + " is " + JSON.stringify(value) + "; expected " + expected);
}
