// Stands in for Flamenco's manager, as far as our job types see it: node flamenco_manager.js SCRIPT < SETTINGS.json
// Prints the job type, and the tasks or the error that compileJob ended with, as JSON.
"use strict";

const fs = require("fs");
const vm = require("vm");

const tasks = [];
// As the manager does, a task is copied when it is added: what is done to it later is lost.
const job = { name: "a job", settings: JSON.parse(fs.readFileSync(0, "utf8")), addTask: (task) => tasks.push(JSON.parse(JSON.stringify(task))) };

const author = {
    Task(name, type) {
        if (!name.trim() || !type.trim()) {
            throw new Error("a task needs a name and a type");
        }
        const task = { name: name.trim(), type: type.trim(), dependencies: [], commands: [] };
        const hidden = {
            addCommand: (command) => { task.commands.push(command); },
            addDependency: (other) => { task.dependencies.push(other.name); },
        };
        return Object.assign(Object.create(hidden), task);
    },
    Command: (name, parameters) => ({ name, parameters }),
};

const path = { stem: (file) => file.replace(/\\/g, "/").replace(/^.*\//, "").replace(/\.[^.]*$/, "") };

function frameChunker(range, size) {
    const frames = new Set();
    for (const part of range.replace(/\.\./g, "-").split(",")) {
        const ends = part.split("-").map((end) => (/^\s*\d+\s*$/.test(end) ? Number(end) : NaN));
        if (ends.length > 2 || ends.some(isNaN)) {
            throw new Error("invalid range " + range);
        }
        for (let frame = ends[0]; frame <= ends[ends.length - 1]; frame++) {
            frames.add(frame);
        }
    }
    const sorted = [...frames].sort((a, b) => a - b);
    const chunks = [];
    for (let i = 0; i < sorted.length; i += size) {
        const chunk = sorted.slice(i, i + size);
        const whole = chunk.length > 2 && chunk[chunk.length - 1] - chunk[0] === chunk.length - 1;
        chunks.push(whole ? chunk[0] + "-" + chunk[chunk.length - 1] : chunk.join(","));
    }
    return chunks;
}

const context = vm.createContext({ author, path, frameChunker, print: () => undefined });
vm.runInContext('"use strict";' + fs.readFileSync(process.argv[2], "utf8"), context, process.argv[2]);
const answer = { type: vm.runInContext("JOB_TYPE", context) };
try {
    vm.runInContext("compileJob", context)(job);
    answer.tasks = tasks;
} catch (error) {
    answer.error = String(error.message);
}
console.log(JSON.stringify(answer));
