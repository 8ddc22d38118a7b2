// Tools of others: node - COMMAND INPUT OUTPUT ... < foreign_tools.mjs, in the folder with node_modules.
//
// A cloud is JSON with one array an attribute, as in Niantic's library: positions, logarithms of scales, rotations
// x y z w, logits, colours, and harmonics with red, green and blue of each coefficient in a row.
import { readFileSync, writeFileSync } from 'node:fs';
import { pathToFileURL } from 'node:url';

let content, buffer, output;
const logit = (value) => Math.log(value / (1 - value));
const finite = (value) => (Math.abs(value) === Infinity ? Math.sign(value) * 1e30 : value); // JSON has no infinity
const json = (value) =>
    JSON.stringify(value, (_, part) => (ArrayBuffer.isView(part) ? Array.from(part, finite) : part));

function cloud() {
    const read = JSON.parse(content);
    for (const [name, values] of Object.entries(read)) if (Array.isArray(values)) read[name] = new Float32Array(values);
    return read;
}

const commands = {
    async 'read-spz'() {
        const spz = await (await import('@adobe/spz')).default();
        const { extensions, ...read } = spz.loadSpzFromBuffer(content, { to: spz.CoordinateSystem.RDF });
        return json(read);
    },
    async 'write-spz'() {
        const spz = await (await import('@adobe/spz')).default();
        const { version, ...given } = cloud();
        const options = { version, from: spz.CoordinateSystem.RDF, sh1Bits: 5, shRestBits: 4 };
        return spz.saveSpzToBuffer({ ...given, extensions: [] }, options);
    },
    async 'read-spz-js'() {
        return json(await (await import('spz-js')).loadSpz(content));
    },
    async 'write-spz-js'() {
        return new Uint8Array(await (await import('spz-js')).serializeSpz(cloud()));
    },
    async 'write-splat'() {
        const { PLYLoader, Scene } = await import('gsplat');
        return PLYLoader.LoadFromArrayBuffer(buffer, new Scene()).data.serialize();
    },
    async 'write-ksplat'() {
        const { PlyParser, SplatBufferGenerator } = await import('@mkkellogg/gaussian-splats-3d');
        const level = Number(output.match(/(\d)\.ksplat$/)[1]);
        const generator = SplatBufferGenerator.getStandardGenerator(0, level);
        const splats = PlyParser.parseToUncompressedSplatArray(buffer, 2);
        return new Uint8Array(generator.generateFromUncompressedSplatArray(splats).bufferData);
    },
    async 'read-splat-glb'() {
        // The engine's parser of the extension, without the engine: its data, before they go to a GPU.
        const folder = pathToFileURL(`${process.cwd()}/node_modules/playcanvas/build/playcanvas/src/`);
        const extension = 'framework/parsers/glb/extensions/khr-gaussian-splatting.js';
        const { khrGaussianSplatting } = await import(new URL(extension, folder));
        const { GSplatData } = await import(new URL('scene/gsplat/gsplat-data.js', folder));
        let data;
        GSplatData.prototype.reorderData = function () {
            data = this;
            throw data;
        };
        const end = 20 + content.readUInt32LE(12);
        const gltf = JSON.parse(content.subarray(20, end));
        const views = gltf.bufferViews.map((view) => {
            const start = end + 8 + (view.byteOffset ?? 0);
            return new Uint8Array(buffer.slice(start, start + view.byteLength));
        });
        try {
            khrGaussianSplatting.createResources(null, gltf, views);
        } catch (error) {
            if (error !== data) throw error;
        }
        const column = (name) => data.getProp(name);
        const rows = (names, change = (value) => value) => {
            const columns = names.map(column);
            return Array.from(columns[0]).flatMap((_, row) => columns.map((values) => change(values[row])));
        };
        let terms = 0;
        while (column(`f_rest_${3 * terms}`)) terms += 1;
        const harmonics = Array.from({ length: 3 * terms }, (_, k) => `f_rest_${(k % 3) * terms + Math.floor(k / 3)}`);
        return json({
            positions: rows(['x', 'y', 'z']),
            scales: rows(['scale_0', 'scale_1', 'scale_2'], Math.log),
            rotations: rows(['rot_1', 'rot_2', 'rot_3', 'rot_0']),
            alphas: rows(['opacity'], logit),
            colors: rows(['f_dc_0', 'f_dc_1', 'f_dc_2']),
            sh: terms ? rows(harmonics) : [],
        });
    },
    async 'read-mesh'() {
        globalThis.self = globalThis;
        const { GLTFLoader } = await import('three/addons/loaders/GLTFLoader.js');
        const loader = new GLTFLoader();
        loader.register((parser) => ({ name: 'no pictures', loadTexture: () => Promise.resolve(null) }));
        const meshes = [];
        (await loader.parseAsync(buffer, '')).scene.traverse((node) => {
            if (!node.isMesh) return;
            const { attributes, index } = node.geometry;
            const parts = Object.entries(attributes).map(([name, part]) => [
                name,
                Array.from({ length: part.count * part.itemSize }, (_, k) =>
                    part.getComponent(Math.floor(k / part.itemSize), k % part.itemSize)),
            ]);
            meshes.push({ material: node.material.type, index: index?.array, ...Object.fromEntries(parts) });
        });
        return json(meshes);
    },
    async validate() {
        const validator = (await import('gltf-validator')).default;
        return json((await validator.validateBytes(new Uint8Array(buffer), { maxIssues: 0 })).issues.messages);
    },
};

const words = process.argv.slice(2);
for (let index = 0; index < words.length; index += 3) {
    const [command, input] = words.slice(index);
    output = words[index + 2];
    content = readFileSync(input);
    buffer = content.buffer.slice(content.byteOffset, content.byteOffset + content.length);
    writeFileSync(output, await commands[command]());
}
