import { createHash } from "node:crypto";
import { readdirSync, readFileSync } from "node:fs";
import { join } from "node:path";
import { defineConfig, type Plugin } from "vite";

const PAPER = "../../report/templates/paper.js"; // figures for a paper are drawn by what reports have for it

/** Every file that the build depends on, in the order of their names. */
function sources(): string[] {
  const inside = readdirSync("src", { recursive: true, withFileTypes: true })
    .filter((entry) => entry.isFile())
    .map((entry) => join(entry.parentPath, entry.name).replaceAll("\\", "/"));
  return ["index.html", "package-lock.json", "package.json", "setup.html", "tsconfig.json", "vite.config.ts", ...inside].sort().concat(PAPER);
}

/** Writes into the build which sources it was made from: tests/page/test_build.py compares, without Node. */
function fingerprint(): Plugin {
  return {
    name: "fingerprint",
    generateBundle() {
      const hash = createHash("sha256");
      for (const name of sources()) hash.update(`${name}\0`).update(readFileSync(name)).update("\0");
      this.emitFile({ type: "asset", fileName: "build.json", source: `{"sources": "${hash.digest("hex")}"}\n` });
    },
  };
}

/** Two pages from one set of sources: the operator's, and with `--mode setup` that of `localizer setup`. */
export default defineConfig(({ mode }) => ({
  base: "./",
  plugins: [fingerprint()],
  build: {
    outDir: mode === "setup" ? "../../../localizer/setup/static" : "../static",
    rollupOptions: { input: mode === "setup" ? "setup.html" : "index.html" },
    emptyOutDir: true,
    target: "es2022",
    modulePreload: { polyfill: false },
    assetsInlineLimit: 0,
  },
}));
